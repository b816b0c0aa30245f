//! Index newtypes: each counts one kind of thing in a [`Program`](crate::Program), from 0.

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
        pub struct $name(u32);

        impl $name {
            /// The id with this index.
            ///
            /// # Panics
            ///
            /// When `index` does not fit 32 bits: a program that large was refused when it was built.
            #[must_use]
            pub fn new(index: usize) -> Self {
                Self(u32::try_from(index).expect("programs have fewer than 2^32 parts"))
            }

            /// The index, for tables.
            #[must_use]
            pub const fn index(self) -> usize {
                self.0 as usize
            }
        }
    };
}

id! {
    /// A reactor instance.
    ReactorId
}
id! {
    /// A port: one channel of an input or output of one reactor instance.
    PortId
}
id! {
    /// Where a present value lives: the root of all ports joined to it without delay.
    SlotId
}
id! {
    /// Anything the event queue can fire: startup, shutdown, timers, actions, delayed connections, network inputs.
    ActionId
}
id! {
    /// Anything that runs at a tag: user reactions first, then forwarders of delayed connections, then senders.
    NodeId
}
id! {
    /// An input that is fed by another federate.
    InputId
}
id! {
    /// An output channel that is sent to another federate; one per remote receiver.
    OutputId
}
id! {
    /// A value held by the executor until its event is due; meaningful only together with its action.
    ValueId
}

impl ValueId {
    /// For events that carry no value.
    pub const NONE: Self = Self(u32::MAX);
}

impl ActionId {
    /// Fires once, at the start tag.
    pub const STARTUP: Self = Self(0);
    /// Fires once, at the stop tag.
    pub const SHUTDOWN: Self = Self(1);
}
