//! What the timeline decides, on small programs without values.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use ictus_core::{
    ActionId, ActionKind, Admission, Delay, Duration, DurationExt, Effects, NodeId, PhysicalTime,
    PortId, PortKind, Program, ProgramBuilder, ProgramError, Progress, ReactionSpec, ReactorId,
    Scheduled, SlotId, Tag, Timeline, Trigger, ValueId,
};
use proptest::prelude::*;
use std::sync::Arc;

fn spec(reactor: ReactorId, triggers: &[Trigger], effects: &[PortId]) -> ReactionSpec {
    ReactionSpec {
        reactor,
        name: "r".into(),
        triggers: triggers.to_vec(),
        sources: Vec::new(),
        effects: effects.to_vec(),
        deadline: None,
    }
}

fn tag(nanos: i64, microstep: u32) -> Tag {
    Tag {
        microstep,
        ..Tag::at(nanos)
    }
}

/// Runs the program with bodies that set all their effects, and returns which node ran at which tag.
fn run(program: Program, stop: Tag, schedule: &[(usize, Scheduled)]) -> Vec<(Tag, usize)> {
    let program = Arc::new(program);
    let mut timeline = Timeline::new(Arc::clone(&program));
    timeline.start(Tag::at(0), stop);
    let (mut log, mut effects) = (Vec::new(), Effects::default());
    while !timeline.finished() {
        let tag = timeline.next_tag();
        timeline.begin(tag, &mut Vec::new());
        loop {
            let mut batch = Vec::new();
            if timeline.ready(&mut batch) != Progress::Batch {
                break;
            }
            for node in &batch {
                log.push((tag, node.index()));
                if let Some(reaction) = program.reactions().get(node.index()) {
                    effects
                        .set
                        .extend(reaction.spec.effects.iter().map(|p| program.slot(*p)));
                }
                let mine = schedule.iter().filter(|(index, _)| *index == node.index());
                effects
                    .scheduled
                    .extend(mine.map(|(_, scheduled)| *scheduled));
            }
            timeline.finish(&batch, &mut effects);
        }
        timeline.complete();
    }
    log
}

fn timer(builder: &mut ProgramBuilder, period: Duration) -> Trigger {
    Trigger::Action(builder.action(ActionKind::Timer {
        offset: Duration::ZERO,
        period,
    }))
}

#[test]
fn reactions_of_a_reactor_run_in_declared_order_and_readers_after_writers() {
    let mut builder = ProgramBuilder::new();
    let (a, b) = (builder.reactor("a"), builder.reactor("b"));
    let out = builder.port(a, "out", PortKind::Output);
    let input = builder.port(b, "in", PortKind::Input);
    builder.connect(out, input, Delay::None);
    let tick = timer(&mut builder, 10.ns());
    builder.reaction(spec(b, &[Trigger::Port(input)], &[]));
    builder.reaction(spec(a, &[tick], &[]));
    builder.reaction(spec(a, &[tick], &[out]));
    let log = run(builder.build().unwrap(), tag(10, 0), &[]);
    let at = |t| vec![(tag(t, 0), 1), (tag(t, 0), 2), (tag(t, 0), 0)];
    assert_eq!(log, [at(0), at(10)].concat());
}

#[test]
fn after_zero_is_one_microstep_and_no_delay_is_none() {
    let mut builder = ProgramBuilder::new();
    let a = builder.reactor("a");
    let tick = timer(&mut builder, Duration::ZERO);
    let out = builder.port(a, "out", PortKind::Output);
    builder.reaction(spec(a, &[tick], &[out]));
    for (name, delay) in [("none", Delay::None), ("zero", Delay::Microstep)] {
        let reactor = builder.reactor(name);
        let input = builder.port(reactor, "in", PortKind::Input);
        builder.connect(out, input, delay);
        builder.reaction(spec(reactor, &[Trigger::Port(input)], &[]));
    }
    let program = builder.build().unwrap();
    // Node 3 is the forwarder of the delayed connection; what it schedules is the executor's to say.
    let action = (0..program.actions().len())
        .map(ActionId::new)
        .find(|a| matches!(program.actions()[a.index()], ActionKind::Connection { .. }))
        .unwrap();
    let forward = Scheduled {
        action,
        delay: Duration::ZERO,
        value: ValueId::new(0),
    };
    let log = run(program, tag(5, 0), &[(3, forward)]);
    assert_eq!(
        log,
        [
            (tag(0, 0), 0),
            (tag(0, 0), 1),
            (tag(0, 0), 3),
            (tag(0, 1), 2)
        ]
    );
}

#[test]
fn the_nth_event_for_one_tag_goes_n_microsteps_later() {
    let mut builder = ProgramBuilder::new();
    let a = builder.reactor("a");
    let action = builder.action(ActionKind::Logical { min_delay: 5.ns() });
    builder.reaction(spec(a, &[Trigger::Action(ActionId::STARTUP)], &[]));
    builder.reaction(spec(a, &[Trigger::Action(action)], &[]));
    let event = Scheduled {
        action,
        delay: Duration::ZERO,
        value: ValueId::NONE,
    };
    let log = run(
        builder.build().unwrap(),
        tag(9, 0),
        &[(0, event), (0, event), (0, event)],
    );
    let ran: Vec<Tag> = log
        .iter()
        .filter(|(_, node)| *node == 1)
        .map(|(t, _)| *t)
        .collect();
    assert_eq!(ran, [tag(5, 0), tag(5, 1), tag(5, 2)]);
}

#[test]
fn shutdown_runs_at_the_stop_tag_with_what_else_is_due() {
    let mut builder = ProgramBuilder::new();
    let a = builder.reactor("a");
    let tick = timer(&mut builder, 4.ns());
    builder.reaction(spec(a, &[tick], &[]));
    builder.reaction(spec(a, &[Trigger::Action(ActionId::SHUTDOWN)], &[]));
    let log = run(builder.build().unwrap(), tag(8, 0), &[]);
    let expected = [
        (tag(0, 0), 0),
        (tag(4, 0), 0),
        (tag(8, 0), 0),
        (tag(8, 0), 1),
    ];
    assert_eq!(log, expected);
}

#[test]
fn a_causality_loop_is_refused_with_its_ports() {
    let mut builder = ProgramBuilder::new();
    let mut ports = Vec::new();
    for name in ["a", "b"] {
        let reactor = builder.reactor(name);
        let input = builder.port(reactor, "in", PortKind::Input);
        let out = builder.port(reactor, "out", PortKind::Output);
        builder.reaction(spec(reactor, &[Trigger::Port(input)], &[out]));
        ports.push((input, out));
    }
    builder.connect(ports[0].1, ports[1].0, Delay::None);
    builder.connect(ports[1].1, ports[0].0, Delay::None);
    let ProgramError::CausalityLoop { ports } = builder.build().unwrap_err() else {
        panic!("a loop")
    };
    for port in ["a.out", "b.out"] {
        assert!(ports.iter().any(|p| p == port), "{ports:?}");
    }
}

#[test]
fn wrong_wiring_is_refused() {
    let mut builder = ProgramBuilder::new();
    let (a, b) = (builder.reactor("a"), builder.reactor("b"));
    let (x, y) = (
        builder.port(a, "x", PortKind::Output),
        builder.port(a, "y", PortKind::Output),
    );
    let input = builder.port(b, "in", PortKind::Input);
    builder.connect(x, input, Delay::None);
    builder.connect(y, input, Delay::Microstep);
    let expected = ProgramError::ManyWriters {
        port: "b.in".into(),
        first: "a.y".into(),
        second: "a.x".into(),
    };
    let error = builder.build().unwrap_err();
    let swapped = matches!(&error, ProgramError::ManyWriters { first, second, .. }
        if first == "a.x" && second == "a.y");
    assert!(error == expected || swapped, "{error}");
}

/// p -> q -> out in A beside an independent r that reads B's answer: `out` must go out before r's input is known.
fn cone_program() -> (Arc<Program>, NodeId, NodeId) {
    let mut builder = ProgramBuilder::new();
    let (p, q, r) = (
        builder.reactor("p"),
        builder.reactor("q"),
        builder.reactor("r"),
    );
    let middle = builder.port(p, "out", PortKind::Output);
    let q_in = builder.port(q, "in", PortKind::Input);
    let out = builder.port(q, "out", PortKind::Output);
    let answer = builder.port(r, "in", PortKind::Input);
    builder.connect(middle, q_in, Delay::None);
    let tick = timer(&mut builder, Duration::ZERO);
    builder.reaction(spec(p, &[tick], &[middle]));
    builder.reaction(spec(q, &[Trigger::Port(q_in)], &[out]));
    let reader = builder.reaction(spec(r, &[Trigger::Port(answer), tick], &[]));
    builder.network_input(answer, false);
    builder.network_output(out);
    let program = builder.build().unwrap();
    let sender = NodeId::new(program.node_count() - 1);
    (Arc::new(program), reader, sender)
}

fn drive(timeline: &mut Timeline, program: &Program) -> (Vec<usize>, Progress) {
    let (mut ran, mut effects) = (Vec::new(), Effects::default());
    loop {
        let mut batch = Vec::new();
        match timeline.ready(&mut batch) {
            Progress::Batch => {}
            progress @ (Progress::InFlight | Progress::Blocked | Progress::TagDone) => {
                return (ran, progress);
            }
        }
        for node in &batch {
            ran.push(node.index());
            if let Some(reaction) = program.reactions().get(node.index()) {
                let slots: Vec<SlotId> = reaction
                    .spec
                    .effects
                    .iter()
                    .map(|port| program.slot(*port))
                    .collect();
                effects.set.extend(slots);
            }
        }
        timeline.finish(&batch, &mut effects);
    }
}

#[test]
fn a_reaction_waits_only_for_the_inputs_of_its_own_cone() {
    let (program, reader, sender) = cone_program();
    let mut timeline = Timeline::new(Arc::clone(&program));
    timeline.start(Tag::at(0), Tag::FOREVER);
    timeline.begin(Tag::at(0), &mut Vec::new());
    let (ran, progress) = drive(&mut timeline, &program);
    assert_eq!(
        (ran, progress),
        (vec![0, 1, sender.index()], Progress::Blocked)
    );
    let input = ictus_core::InputId::new(0);
    let admission = timeline.admit(input, Tag::at(0), ValueId::new(0));
    assert_eq!(admission, Admission::IntoCurrentTag);
    let (ran, progress) = drive(&mut timeline, &program);
    assert_eq!((ran, progress), (vec![reader.index()], Progress::TagDone));
    assert!(timeline.complete(), "a network input ran");
}

#[test]
fn an_output_is_absent_as_soon_as_its_last_writer_is_done() {
    let (program, _, sender) = cone_program();
    let mut timeline = Timeline::new(Arc::clone(&program));
    timeline.start(Tag::at(0), Tag::FOREVER);
    timeline.begin(Tag::at(0), &mut Vec::new());
    assert!(!timeline.settled_without(sender), "p may still lead to it");
    let mut batch = Vec::new();
    timeline.ready(&mut batch);
    let first: Vec<NodeId> = batch.iter().copied().filter(|n| n.index() == 0).collect();
    assert_eq!(first.len(), 1);
    timeline.finish(&batch, &mut Effects::default());
    assert!(
        timeline.settled_without(sender),
        "p did not set its output: q will not run"
    );
}

#[test]
fn a_message_for_a_tag_that_is_over_is_tardy() {
    let (program, _, _) = cone_program();
    let mut timeline = Timeline::new(Arc::clone(&program));
    timeline.start(Tag::at(0), Tag::FOREVER);
    timeline.settle_all(Tag::at(5));
    timeline.begin(Tag::at(0), &mut Vec::new());
    drive(&mut timeline, &program);
    timeline.complete();
    let admission = timeline.admit(ictus_core::InputId::new(0), Tag::at(0), ValueId::new(0));
    assert_eq!(
        admission,
        Admission::Tardy {
            intended: Tag::at(0),
            actual: tag(0, 1)
        }
    );
}

proptest! {
    /// A physical event is after the current tag, not before the floor, and spaced from the one before.
    #[test]
    fn physical_events_keep_promises_and_spacing(
        stamps in prop::collection::vec(0i64..1000, 1..20),
        floor in 0i64..500,
        spacing in 0i64..50,
    ) {
        let mut builder = ProgramBuilder::new();
        let a = builder.reactor("a");
        let action = builder.action(ActionKind::Physical {
            min_delay: 3.ns(),
            min_spacing: Duration::from_nanos(spacing),
        });
        builder.reaction(spec(a, &[Trigger::Action(action)], &[]));
        let mut timeline = Timeline::new(Arc::new(builder.build().unwrap()));
        timeline.start(Tag::at(100), Tag::FOREVER);
        let mut last: Option<Tag> = None;
        for stamp in stamps {
            let stamp = PhysicalTime::from_nanos(stamp);
            let tag = timeline.schedule_physical(stamp, action, ValueId::NONE, Tag::at(floor));
            prop_assert!(tag >= Tag::at(floor) && tag >= Tag::at(100));
            prop_assert!(tag.time.as_nanos() >= stamp.as_nanos() + 3);
            if let Some(last) = last {
                prop_assert!(tag > last);
                prop_assert!(tag.time.since(last.time).as_nanos() >= spacing);
            }
            last = Some(tag);
        }
    }
}
