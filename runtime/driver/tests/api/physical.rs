//! Physical actions, which are events from other threads, and physical connections.

use crate::harness::{World, at, d, line};
use ictus::prelude::*;
use ictus::{AssemblyError, Class, SendError};
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

#[reactor]
struct Pulse {
    #[timer(offset = 1.ms())]
    tick: Timer,
    back: Input<u32>,
    out: Output<u32>,
}

#[reactions]
impl Pulse {
    #[reaction]
    fn send(&mut self, _tick: &Timer, #[uses] back: &Input<u32>, out: &mut Output<u32>) {
        out.set(back.get().map_or(1, |value| value + 1));
    }
}

#[reactor]
struct Echo {
    input: Input<u32>,
    out: Output<u32>,
}

#[reactions]
impl Echo {
    #[reaction]
    fn echo(&mut self, input: &Input<u32>, out: &mut Output<u32>) {
        out.set(*input.get().unwrap());
    }
}

fn pulse_and_echo() -> World {
    World::new(&[Class::of::<Pulse>(), Class::of::<Echo>()])
        .federate("pulse", "Pulse", "{}")
        .federate("echo", "Echo", "{}")
        .connect("pulse.out", "echo.input", Some(3.ms()))
        .physical()
}

#[test]
fn a_physical_connection_gives_the_receivers_time_and_after_is_added_there() {
    let world = pulse_and_echo();
    world.clock.set(10.ms());
    let ran = world.run();
    let expected = [
        line((1.ms(), 0), ("pulse", 0), &[("out", d(1_u32))]),
        "# physical 13000000 0 echo.input\n".to_owned()
            + &line((13.ms(), 0), ("echo", 0), &[("out", d(1_u32))]),
    ];
    assert_eq!(ran.traces, expected);
}

#[test]
fn a_physical_connection_breaks_a_causality_loop() {
    let there = || {
        World::new(&[Class::of::<Pulse>(), Class::of::<Echo>()])
            .federate("pulse", "Pulse", "{}")
            .federate("echo", "Echo", "{}")
            .connect("pulse.out", "echo.input", None)
    };
    let back = |world: World| world.connect("echo.out", "pulse.back", None);
    assert!(matches!(
        back(there()).assemble(),
        Err(AssemblyError::Program(_))
    ));
    let ran = back(there().physical()).run();
    assert!(ran.traces[1].starts_with("# physical 1000000 1 echo.input\n"));
}

#[test]
fn a_physical_connection_from_another_process_is_an_input_without_status() {
    let world = pulse_and_echo();
    let sender = world.assemble_some(&[0]).unwrap();
    assert_eq!((sender.inputs, sender.outputs), (vec![], vec![0]));
    assert_eq!(sender.program.least_physical_delay(), None);
    let receiver = world.assemble_some(&[1]).unwrap();
    assert_eq!((receiver.inputs, receiver.outputs), (vec![0], vec![]));
    let input = receiver.program.network_inputs()[0];
    assert!(input.physical && !input.delayed);
    assert_eq!(receiver.program.least_physical_delay(), Some(3.ms()));
}

#[test]
fn fast_is_refused_with_what_the_physical_clock_schedules() {
    let connection = pulse_and_echo().fast();
    for mine in [&[0][..], &[1], &[0, 1]] {
        assert_eq!(
            connection.assemble_some(mine).unwrap_err().to_string(),
            "`fast`, but the physical connection to `echo.input` goes by the physical clock"
        );
    }
    let action = World::of(Class::of::<Once>()).fast();
    assert_eq!(
        action.assemble().unwrap_err().to_string(),
        "`fast`, but the physical action `main.event` goes by the physical clock"
    );
}
