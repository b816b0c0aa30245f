//! What happens to values between being scheduled and being present, one carrier per action of the program.

use crate::action::ActionValues;
use crate::linker::Linker;
use crate::slot::{Epoch, Shared, Signal, Slab, Slot};
use crate::value::{Codec, CodecError, Value};
use ictus_coord::describe::TypeIdentity;
use ictus_core::{PortId, ValueId};
use std::any::Any;
use std::marker::PhantomData;

/// Holds the waiting values of one action and makes them present.
pub(crate) trait Carrier {
    fn link(&mut self, _: &mut Linker<'_>) {}

    /// The event with this value fires.
    fn arrive(&mut self, value: ValueId, epoch: Epoch);

    /// Of a delayed connection: copies the present value of its source.
    fn forward(&mut self) -> ValueId {
        ValueId::NONE
    }

    /// Of a network input: reads a message.
    fn decode(&mut self, _: &[u8]) -> Result<ValueId, CodecError> {
        Ok(ValueId::NONE)
    }

    /// No event will carry this value.
    fn release(&mut self, _: ValueId) {}

    /// Of a physical action: takes a value sent from outside.
    fn accept(&mut self, _: Box<dyn Any + Send>) -> ValueId {
        ValueId::NONE
    }
}

/// Timers, startup, shutdown.
impl Carrier for Signal {
    #[inline]
    fn arrive(&mut self, _: ValueId, epoch: Epoch) {
        self.raise(epoch);
    }
}

/// Logical and physical actions.
impl<T: Value> Carrier for Shared<ActionValues<T>> {
    #[inline]
    fn arrive(&mut self, value: ValueId, epoch: Epoch) {
        let values = &mut *self.write();
        if let Some(value) = values.waiting.take(value) {
            values.slot.set(value, epoch);
        }
    }

    fn release(&mut self, value: ValueId) {
        drop(self.write().waiting.take(value));
    }

    fn accept(&mut self, value: Box<dyn Any + Send>) -> ValueId {
        match value.downcast::<T>() {
            Ok(value) => self.write().waiting.insert(*value),
            Err(_) => ValueId::NONE,
        }
    }
}

/// A delayed connection inside this process.
struct Delayed<T> {
    from: (PortId, Shared<Slot<T>>),
    to: (PortId, Shared<Slot<T>>),
    waiting: Slab<T>,
}

impl<T: Value> Carrier for Delayed<T> {
    fn link(&mut self, linker: &mut Linker<'_>) {
        self.from.1 = linker.slot(self.from.0);
        self.to.1 = linker.slot(self.to.0);
    }

    #[inline]
    fn arrive(&mut self, value: ValueId, epoch: Epoch) {
        if let Some(value) = self.waiting.take(value) {
            self.to.1.write().set(value, epoch);
        }
    }

    #[inline]
    fn forward(&mut self) -> ValueId {
        let value = self.from.1.read().last().cloned();
        value.map_or(ValueId::NONE, |value| self.waiting.insert(value))
    }
}

/// A network input.
struct Receiver<T> {
    to: (PortId, Shared<Slot<T>>),
    codec: Codec<T>,
    waiting: Slab<T>,
}

impl<T: Value> Carrier for Receiver<T> {
    fn link(&mut self, linker: &mut Linker<'_>) {
        self.to.1 = linker.slot(self.to.0);
    }

    #[inline]
    fn arrive(&mut self, value: ValueId, epoch: Epoch) {
        if let Some(value) = self.waiting.take(value) {
            self.to.1.write().set(value, epoch);
        }
    }

    fn decode(&mut self, payload: &[u8]) -> Result<ValueId, CodecError> {
        let value = self.codec.decode_whole(payload)?;
        Ok(self.waiting.insert(value))
    }
}

/// A network output.
pub(crate) trait Sender {
    fn link(&mut self, linker: &mut Linker<'_>);

    /// Appends the present value.
    fn encode(&self, out: &mut Vec<u8>) -> Result<(), CodecError>;
}

struct TypedSender<T> {
    from: (PortId, Shared<Slot<T>>),
    codec: Codec<T>,
}

impl<T: Value> Sender for TypedSender<T> {
    fn link(&mut self, linker: &mut Linker<'_>) {
        self.from.1 = linker.slot(self.from.0);
    }

    fn encode(&self, out: &mut Vec<u8>) -> Result<(), CodecError> {
        match self.from.1.read().last() {
            Some(value) => (self.codec.encode)(value, out),
            None => Ok(()),
        }
    }
}

/// What connections need of a port's type when only its name is known: plans connect ports by name.
pub(crate) trait PortType {
    fn identity(&self) -> TypeIdentity;
    fn serializers(&self) -> Vec<&'static str>;
    fn delayed(&self, from: PortId, to: PortId) -> Box<dyn Carrier>;
    fn receiver(&self, to: PortId, serializer: &str) -> Option<Box<dyn Carrier>>;
    fn sender(&self, from: PortId, serializer: &str) -> Option<Box<dyn Sender>>;
}

pub(crate) struct Typed<T>(PhantomData<fn() -> T>);

impl<T: Value> Typed<T> {
    pub(crate) const fn new() -> Self {
        Self(PhantomData)
    }

    fn codec(serializer: &str) -> Option<Codec<T>> {
        let mut offered = T::serializers().into_iter();
        offered.find_map(|(name, codec)| (name == serializer).then_some(codec))
    }
}

impl<T: Value> PortType for Typed<T> {
    fn identity(&self) -> TypeIdentity {
        crate::value::identity::<T>()
    }

    fn serializers(&self) -> Vec<&'static str> {
        T::serializers().into_iter().map(|(name, _)| name).collect()
    }

    fn delayed(&self, from: PortId, to: PortId) -> Box<dyn Carrier> {
        Box::new(Delayed::<T> {
            from: (from, Shared::new(Slot::new())),
            to: (to, Shared::new(Slot::new())),
            waiting: Slab::new(),
        })
    }

    fn receiver(&self, to: PortId, serializer: &str) -> Option<Box<dyn Carrier>> {
        Some(Box::new(Receiver::<T> {
            to: (to, Shared::new(Slot::new())),
            codec: Self::codec(serializer)?,
            waiting: Slab::new(),
        }))
    }

    fn sender(&self, from: PortId, serializer: &str) -> Option<Box<dyn Sender>> {
        Some(Box::new(TypedSender::<T> {
            from: (from, Shared::new(Slot::new())),
            codec: Self::codec(serializer)?,
        }))
    }
}
