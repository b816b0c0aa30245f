//! The event queue: a heap ordered by tag, then action.

use crate::id::{ActionId, ValueId};
use crate::tag::Tag;
use crate::time::LogicalTime;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// Pending events. At most one event per action and tag: the caller spaces collisions out.
#[derive(Debug, Default)]
pub(crate) struct EventQueue {
    heap: BinaryHeap<Reverse<(Key, u32)>>,
}

/// Tag and action packed so that one comparison orders events: time (biased to unsigned), microstep, action.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Debug)]
struct Key(u128);

const SIGN: u64 = 1 << 63;

impl Key {
    #[inline]
    fn new(tag: Tag, action: ActionId) -> Self {
        let time = tag.time.as_nanos().cast_unsigned() ^ SIGN;
        let low = (u128::from(tag.microstep) << 32) | action.index() as u128;
        Self((u128::from(time) << 64) | low)
    }

    #[inline]
    #[expect(clippy::cast_possible_truncation, reason = "unpacks what `new` packed")]
    fn tag(self) -> Tag {
        let time = ((self.0 >> 64) as u64 ^ SIGN).cast_signed();
        Tag::new(LogicalTime::from_nanos(time), (self.0 >> 32) as u32)
    }

    #[inline]
    #[expect(clippy::cast_possible_truncation, reason = "unpacks what `new` packed")]
    fn action(self) -> ActionId {
        ActionId::new((self.0 as u32) as usize)
    }
}

#[inline]
fn pack(value: ValueId) -> u32 {
    u32::try_from(value.index()).unwrap_or(u32::MAX)
}

impl EventQueue {
    #[inline]
    pub(crate) fn push(&mut self, tag: Tag, action: ActionId, value: ValueId) {
        self.heap
            .push(Reverse((Key::new(tag, action), pack(value))));
    }

    /// The tag of the earliest event.
    #[inline]
    pub(crate) fn next_tag(&self) -> Option<Tag> {
        self.heap.peek().map(|Reverse((key, _))| key.tag())
    }

    /// Takes the earliest event if it is due at `tag` or before.
    #[inline]
    pub(crate) fn pop_through(&mut self, tag: Tag) -> Option<(ActionId, ValueId)> {
        let Reverse((key, value)) = *self.heap.peek()?;
        if key.tag() > tag {
            return None;
        }
        self.heap.pop();
        Some((key.action(), ValueId::new(value as usize)))
    }

    /// Whether `action` has an event at `tag`. O(pending events).
    pub(crate) fn contains(&self, tag: Tag, action: ActionId) -> bool {
        let key = Key::new(tag, action);
        self.heap.iter().any(|Reverse((k, _))| *k == key)
    }

    /// Gives the event of `action` at `tag` another value and returns the former one; `None` when there is no such event.
    /// O(pending events).
    pub(crate) fn replace(
        &mut self,
        tag: Tag,
        action: ActionId,
        value: ValueId,
    ) -> Option<ValueId> {
        let key = Key::new(tag, action);
        let mut events = std::mem::take(&mut self.heap).into_vec();
        let event = events.iter_mut().find(|Reverse((k, _))| *k == key);
        let former = event.map(|Reverse((_, held))| std::mem::replace(held, pack(value)));
        self.heap = events.into();
        former.map(|former| ValueId::new(former as usize))
    }

    pub(crate) fn len(&self) -> usize {
        self.heap.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn events_come_out_in_tag_order(tags in prop::collection::vec((any::<i64>(), any::<u32>(), 0usize..4), 0..50)) {
            let mut queue = EventQueue::default();
            for (i, (time, microstep, action)) in tags.iter().enumerate() {
                let tag = Tag::new(LogicalTime::from_nanos(*time), *microstep);
                queue.push(tag, ActionId::new(*action), ValueId::new(i));
            }
            let mut last = Tag::NEVER;
            while let Some(tag) = queue.next_tag() {
                prop_assert!(tag >= last);
                let (action, value) = queue.pop_through(tag).unwrap();
                let (time, microstep, expected) = tags[value.index()];
                prop_assert_eq!(tag, Tag::new(LogicalTime::from_nanos(time), microstep));
                prop_assert_eq!(action.index(), expected);
                last = tag;
            }
        }
    }
}
