//! Physical actions: events from other threads.

use crate::harness::{World, at, d, line};
use ictus::Class;
use ictus::SendError;
use ictus::prelude::*;
use std::sync::{Mutex, OnceLock};

static SENDER: OnceLock<PhysicalSender<u32>> = OnceLock::new();
static LATER: Mutex<Option<PhysicalSender<String>>> = Mutex::new(None);

#[reactor]
struct Keys {
    #[action(min_delay = 2.ms(), min_spacing = 5.ms())]
    key: PhysicalAction<u32>,
    last: Output<u32>,
}

#[reactions]
impl Keys {
    #[reaction]
    fn begin(&mut self, _: &Startup, #[uses] key: &PhysicalAction<u32>) {
        let sender = key.sender();
        assert!(SENDER.set(sender.clone()).is_ok());
        let thread = std::thread::spawn(move || {
            sender.schedule(1).unwrap();
            sender.schedule(2).unwrap();
        });
        thread.join().unwrap();
    }

    #[reaction]
    fn on_key(&mut self, key: &PhysicalAction<u32>, last: &mut Output<u32>) {
        last.set(*key.get().unwrap());
    }
}

#[test]
fn events_from_a_thread_get_the_clocks_time_and_keep_their_spacing() {
    let world = World::of(Class::of::<Keys>()).timeout(100.ms());
    world.clock.set(10.ms());
    let ran = world.run();
    assert_eq!(ran.fault, None);
    let expected = [
        line((0.ms(), 0), ("main", 0), &[]),
        "# physical 12000000 0 main.key\n".to_owned(),
        "# physical 17000000 0 main.key\n".to_owned(),
        line((12.ms(), 0), ("main", 1), &[("last", d(1_u32))]),
        line((17.ms(), 0), ("main", 1), &[("last", d(2_u32))]),
    ];
    assert_eq!(ran.traces, [expected.concat()]);
    assert_eq!(ran.end, at(100.ms(), 0));
}

#[reactor]
struct Once {
    event: PhysicalAction<String>,
}

#[reactions]
impl Once {
    #[reaction]
    fn begin(&mut self, _: &Startup, event: &mut PhysicalAction<String>) {
        *LATER.lock().unwrap() = Some(event.sender());
    }
}

#[test]
fn after_the_end_the_value_comes_back() {
    let world = World::of(Class::of::<Once>());
    let mut assembly = world.assemble().unwrap();
    world.run_assembly(&mut assembly);
    assembly.bodies.outside().close();
    let sender = LATER.lock().unwrap().take().unwrap();
    assert_eq!(
        sender.schedule("late".to_owned()),
        Err(SendError("late".to_owned()))
    );
}
