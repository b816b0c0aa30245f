//! Connections among children, and between children and their container.

use crate::carrier::{PortType, Typed};
use crate::port::{Input, Multi, Output};
use crate::scope::{Elaboration, WiringError};
use crate::value::Value;
use ictus_core::{Delay, Duration, PortId, PortKind, ReactorId};
use std::fmt;

/// Collects the connections of one reactor.
#[derive(Default)]
pub struct Wiring {
    links: Vec<Link>,
}

/// A connection; [`Link::after`] gives it a delay.
pub struct Link {
    from: Vec<PortId>,
    to: Vec<PortId>,
    delay: Delay,
    broadcast: bool,
    typed: Box<dyn PortType>,
}

/// A port of any kind as one end of a connection of values of type `T`.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be connected to a port of `{T}`",
    label = "not a port of `{T}`"
)]
pub trait End<T> {
    /// The channels.
    fn channels(&self) -> Vec<PortId>;
}

impl<T: Value> End<T> for Input<T> {
    fn channels(&self) -> Vec<PortId> {
        vec![self.port()]
    }
}

impl<T: Value> End<T> for Output<T> {
    fn channels(&self) -> Vec<PortId> {
        vec![self.port()]
    }
}

impl<T, P: End<T>> End<T> for Multi<P> {
    fn channels(&self) -> Vec<PortId> {
        self.iter().flat_map(End::channels).collect()
    }
}

impl Wiring {
    /// Connects `from` (a child's output or the reactor's own input) to `to` (a child's input or its own output),
    /// channel by channel: both have the same number of channels.
    pub fn connect<T: Value>(&mut self, from: &impl End<T>, to: &impl End<T>) -> &mut Link {
        self.link::<T>(from.channels(), to.channels(), false)
    }

    /// Connects `from` to every channel of `to`, starting again with its first channel when they run out.
    pub fn broadcast<T: Value>(&mut self, from: &impl End<T>, to: &impl End<T>) -> &mut Link {
        self.link::<T>(from.channels(), to.channels(), true)
    }

    fn link<T: Value>(&mut self, from: Vec<PortId>, to: Vec<PortId>, broadcast: bool) -> &mut Link {
        self.links.push(Link {
            from,
            to,
            delay: Delay::None,
            broadcast,
            typed: Box::new(Typed::<T>::new()),
        });
        self.links.last_mut().expect("one was pushed")
    }

    /// Adds the connections of the container `reactor`, whose path is `path`.
    pub(crate) fn apply(self, reactor: ReactorId, path: &str, elaboration: &mut Elaboration) {
        for link in self.links {
            let fits = if link.broadcast {
                link.to.is_empty() || !link.from.is_empty()
            } else {
                link.from.len() == link.to.len()
            };
            if !fits {
                elaboration.errors.push(WiringError::Widths {
                    path: path.to_owned(),
                    from: link.from.len(),
                    to: link.to.len(),
                });
                continue;
            }
            if let Some(error) = link.misdirected(reactor, path, elaboration) {
                elaboration.errors.push(error);
                continue;
            }
            for ends in link.from.iter().copied().cycle().zip(link.to) {
                elaboration.connect(ends, link.delay, &*link.typed);
            }
        }
    }
}

impl Link {
    /// A connection goes from a child's output or an own port to a child's input or an own output.
    fn misdirected(
        &self,
        reactor: ReactorId,
        path: &str,
        elaboration: &Elaboration,
    ) -> Option<WiringError> {
        let is = |port: &PortId, own: Option<PortKind>, child: PortKind| {
            let (owner, kind) = elaboration.program.owner(*port);
            if owner == reactor {
                own.is_none_or(|own| kind == own)
            } else {
                kind == child
            }
        };
        let (mut from, mut to) = (self.from.iter(), self.to.iter());
        let wrong_from = from.find(|p| !is(p, None, PortKind::Output));
        let wrong_to = to.find(|p| !is(p, Some(PortKind::Output), PortKind::Input));
        let (port, side) = match (wrong_from, wrong_to) {
            (Some(port), _) => (port, "from"),
            (None, Some(port)) => (port, "to"),
            (None, None) => return None,
        };
        Some(WiringError::Direction {
            path: path.to_owned(),
            side,
            port: elaboration.program.port_path(*port),
        })
    }

    /// Delays the connection; zero is one microstep, which is not the same as no delay.
    pub const fn after(&mut self, delay: Duration) {
        self.delay = Delay::after(delay);
    }
}

impl fmt::Debug for Wiring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(&self.links).finish()
    }
}

impl fmt::Debug for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:?} -> {:?} {:?}", self.from, self.to, self.delay)
    }
}
