//! What the timeline decides, on small programs without values.

#![expect(clippy::unwrap_used, reason = "a test stops at the first surprise")]

use ictus_core::{
    ActionId, ActionKind, Admission, Delay, Duration, DurationExt, Effects, NodeId, PhysicalTime,
    PortId, PortKind, Program, ProgramBuilder, ProgramError, Progress, ReactionSpec, ReactorId,
    Scheduled, SlotId, Spacing, SpacingPolicy, Tag, Timeline, Trigger, ValueId,
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
    let action = builder.action(ActionKind::Logical {
        min_delay: 5.ns(),
        spacing: Spacing::NONE,
    });
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
            spacing: Spacing {
                min: Duration::from_nanos(spacing),
                policy: SpacingPolicy::Defer,
            },
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

/// An input fed by the network, its reader, what the reader triggers, and a reaction that nothing late reaches.
///
/// Nodes: 0 and 1 read one input each and set `middle[0]` and `middle[1]`; 2 reads both; 3 has a timer of 10 ns.
fn late_program() -> Arc<Program> {
    let mut builder = ProgramBuilder::new();
    let last = builder.reactor("last");
    let mut triggers = Vec::new();
    for name in ["a", "b"] {
        let reactor = builder.reactor(name);
        let input = builder.port(reactor, "in", PortKind::Input);
        let out = builder.port(reactor, "out", PortKind::Output);
        let end = builder.port(last, name, PortKind::Input);
        builder.connect(out, end, Delay::None);
        builder.network_input(input, false);
        builder.reaction(spec(reactor, &[Trigger::Port(input)], &[out]));
        triggers.push(Trigger::Port(end));
    }
    let other = builder.reactor("other");
    let tick = timer(&mut builder, 10.ns());
    builder.reaction(spec(last, &triggers, &[]));
    builder.reaction(spec(other, &[tick], &[]));
    Arc::new(builder.build().unwrap())
}

/// Runs the next tag node by node; returns it and which node ran with which intended tag.
fn step(timeline: &mut Timeline) -> (Tag, Vec<(usize, Option<Tag>)>) {
    let program = Arc::clone(timeline.program());
    let tag = timeline.next_tag();
    timeline.begin(tag, &mut Vec::new());
    let (mut ran, mut effects) = (Vec::new(), Effects::default());
    let mut batch = Vec::new();
    while timeline.ready(&mut batch) == Progress::Batch {
        for node in batch.drain(..) {
            ran.push((node.index(), timeline.tardy(node)));
            let spec = &program.reactions()[node.index()].spec;
            let set = spec.effects.iter().map(|port| program.slot(*port));
            effects.set.extend(set);
            timeline.finish(&[node], &mut effects);
            assert_eq!(timeline.tardy(node), None, "it is done");
        }
    }
    assert!(!timeline.any_tardy());
    timeline.complete();
    ran.sort_unstable_by_key(|(node, _)| *node);
    (tag, ran)
}

fn input(index: usize) -> ictus_core::InputId {
    ictus_core::InputId::new(index)
}

#[test]
fn what_a_tardy_message_leads_to_is_tardy_and_nothing_else() {
    let mut timeline = Timeline::new(late_program());
    timeline.start(Tag::at(0), Tag::FOREVER);
    timeline.settle_all(Tag::at(30));
    assert_eq!(step(&mut timeline), (Tag::at(0), vec![(3, None)]));
    timeline.admit(input(1), Tag::at(0), ValueId::new(0));
    timeline.admit(input(0), tag(0, 1), ValueId::new(0));
    // `a` is in time, `b` is not, and what both lead to is not.
    let late = Some(Tag::at(0));
    assert_eq!(
        step(&mut timeline),
        (tag(0, 1), vec![(0, None), (1, late), (2, late)])
    );
    timeline.admit(input(0), tag(10, 0), ValueId::new(0));
    assert_eq!(
        step(&mut timeline),
        (Tag::at(10), vec![(0, None), (2, None), (3, None)])
    );
}

#[test]
fn an_input_decided_while_its_tag_runs_is_tardy_at_the_next_microstep() {
    let mut timeline = Timeline::new(late_program());
    timeline.start(Tag::at(0), Tag::FOREVER);
    timeline.settle(input(0), Tag::at(0));
    timeline.begin(Tag::at(0), &mut Vec::new());
    assert_eq!(timeline.unknown_inputs().collect::<Vec<_>>(), [input(1)]);
    assert_eq!(timeline.known(input(0)), Tag::at(0));
    assert_eq!(timeline.known(input(1)), Tag::NEVER);
    timeline.settle(input(1), Tag::at(0));
    assert_eq!(timeline.unknown_inputs().count(), 0);
    let program = Arc::clone(timeline.program());
    drive(&mut timeline, &program);
    let admission = timeline.admit(input(1), Tag::at(0), ValueId::new(0));
    let actual = tag(0, 1);
    assert_eq!(
        admission,
        Admission::Tardy {
            intended: Tag::at(0),
            actual
        }
    );
    assert!(!timeline.any_tardy(), "not at this tag");
    timeline.complete();
    timeline.settle_all(actual);
    let late = Some(Tag::at(0));
    assert_eq!(step(&mut timeline), (actual, vec![(1, late), (2, late)]));
}

#[test]
fn tardy_events_are_dropped_with_the_rest_when_only_shutdown_is_left() {
    let mut timeline = Timeline::new(late_program());
    timeline.start(Tag::at(0), Tag::at(50));
    timeline.settle_all(Tag::at(0));
    step(&mut timeline);
    timeline.admit(input(0), Tag::at(0), ValueId::new(0));
    timeline.begin_shutdown_only(&mut Vec::new());
    assert!(!timeline.any_tardy());
}

#[test]
fn a_physical_input_is_never_unknown_and_breaks_the_loop() {
    let mut builder = ProgramBuilder::new();
    let (a, b) = (builder.reactor("a"), builder.reactor("b"));
    let (from, back) = (
        builder.port(a, "out", PortKind::Output),
        builder.port(a, "in", PortKind::Input),
    );
    let (to, answer) = (
        builder.port(b, "in", PortKind::Input),
        builder.port(b, "out", PortKind::Output),
    );
    let far = builder.port(b, "far", PortKind::Input);
    let connection = builder.connect_physical(from, to, 5.ns());
    builder.connect(answer, back, Delay::None);
    let start = Trigger::Action(ActionId::STARTUP);
    builder.reaction(spec(a, &[start, Trigger::Port(back)], &[from]));
    builder.reaction(spec(b, &[Trigger::Port(to), Trigger::Port(far)], &[answer]));
    let network = builder.network_input_physical(far, 2.ns());
    let program = Arc::new(builder.build().unwrap());
    assert_eq!(program.least_physical_delay(), Some(2.ns()));
    assert!(!program.depends_without_delay(from, to));

    let mut timeline = Timeline::new(Arc::clone(&program));
    timeline.start(Tag::at(10), Tag::FOREVER);
    timeline.unsettle_after(Tag::at(10));
    assert_eq!(timeline.known(network), Tag::FOREVER);
    timeline.begin(Tag::at(10), &mut Vec::new());
    assert_eq!(timeline.unknown_inputs().count(), 0);
    let (ran, progress) = drive(&mut timeline, &program);
    // Node 2 is the connection's forwarder.
    assert_eq!((ran, progress), (vec![0, 2], Progress::TagDone));
    let mut effects = Effects::default();
    effects.forward(&program, connection, ValueId::new(7));
    timeline.finish(&[], &mut effects);
    assert_eq!(effects.physical, [(connection, ValueId::new(7))]);
    assert!(!timeline.complete(), "no message with a tag was there");
    let event = |timeline: &mut Timeline, action, now| {
        let stamp = PhysicalTime::from_nanos(now);
        timeline.schedule_physical(stamp, action, ValueId::new(7), Tag::NEVER)
    };
    assert_eq!(event(&mut timeline, connection, 20), Tag::at(25));
    assert_eq!(event(&mut timeline, connection, 20), tag(25, 1));
    let action = program.network_inputs()[network.index()].action;
    assert_eq!(event(&mut timeline, action, 3), tag(10, 1));
    let mut present = Vec::new();
    timeline.begin(tag(10, 1), &mut present);
    assert_eq!(present, [(action, ValueId::new(7))]);
    assert_eq!(drive(&mut timeline, &program).0, [1, 0, 2]);
    assert!(!timeline.complete(), "no message with a tag was there");
}

proptest! {
    /// Tardy messages keep their order, one a microstep, and each node runs with the least intended tag that led to it.
    #[test]
    fn tardiness_is_passed_on(messages in prop::collection::vec((0usize..2, 0i64..=50), 1..12)) {
        let mut timeline = Timeline::new(late_program());
        timeline.start(Tag::at(0), Tag::FOREVER);
        timeline.settle_all(Tag::at(55));
        while timeline.at() < Tag::at(50) {
            step(&mut timeline);
        }
        let mut intended: [Vec<Tag>; 2] = Default::default();
        for (value, (index, time)) in messages.into_iter().enumerate() {
            let queue = &mut intended[index];
            let actual = tag(50, u32::try_from(queue.len()).unwrap() + 1);
            let admission = timeline.admit(input(index), Tag::at(time), ValueId::new(value));
            prop_assert_eq!(admission, Admission::Tardy { intended: Tag::at(time), actual });
            queue.push(Tag::at(time));
        }
        for round in 0..intended[0].len().max(intended[1].len()) {
            let late = [intended[0].get(round).copied(), intended[1].get(round).copied()];
            let both = late.iter().flatten().min().copied();
            let expected: Vec<_> = [(0, late[0]), (1, late[1]), (2, both)]
                .into_iter()
                .filter(|(_, late)| late.is_some())
                .collect();
            let (at, ran) = step(&mut timeline);
            prop_assert_eq!(at, tag(50, u32::try_from(round).unwrap() + 1));
            prop_assert_eq!(ran, expected);
        }
        prop_assert_eq!(timeline.next_tag(), Tag::at(60));
    }
}

fn spaced(policy: SpacingPolicy) -> (Timeline, ActionId) {
    let mut builder = ProgramBuilder::new();
    let a = builder.reactor("a");
    let action = builder.action(ActionKind::Physical {
        min_delay: Duration::ZERO,
        spacing: Spacing {
            min: 10.ns(),
            policy,
        },
    });
    builder.reaction(spec(a, &[Trigger::Action(action)], &[]));
    let mut timeline = Timeline::new(Arc::new(builder.build().unwrap()));
    timeline.start(Tag::at(0), Tag::FOREVER);
    (timeline, action)
}

proptest! {
    /// Whatever the policy: events are handled at least the spacing apart, every value is handled once or released once, and
    /// - defer releases none;
    /// - drop handles each event at its own tag;
    /// - replace never delays an event for longer than defer does, and handles the newest value last.
    #[test]
    fn spacing_keeps_events_apart_and_loses_no_value(
        steps in prop::collection::vec((0i64..8, any::<bool>()), 1..30),
        policy in prop::sample::select(vec![SpacingPolicy::Defer, SpacingPolicy::Drop, SpacingPolicy::Replace]),
    ) {
        let (mut timeline, action) = spaced(policy);
        let (mut handled, mut released) = (Vec::new(), Vec::new());
        let mut now = 0;
        let mut wanted = Vec::new();
        let mut run = |timeline: &mut Timeline| {
            let tag = timeline.next_tag();
            let mut present = Vec::new();
            timeline.begin(tag, &mut present);
            let mine = present.iter().filter(|(fired, _)| *fired == action);
            handled.extend(mine.map(|(_, value)| (tag, value.index())));
            let program = Arc::clone(timeline.program());
            drive(timeline, &program);
            timeline.complete();
        };
        for (value, (gap, handle)) in steps.into_iter().enumerate() {
            now += gap;
            wanted.push(now);
            let stamp = PhysicalTime::from_nanos(now);
            timeline.schedule_physical(stamp, action, ValueId::new(value), Tag::NEVER);
            while let Some((of, value)) = timeline.pop_released() {
                prop_assert_eq!(of, action);
                released.push(value.index());
            }
            if handle && timeline.next_tag() <= Tag::at(now) {
                run(&mut timeline);
            }
        }
        while timeline.next_tag() != Tag::FOREVER {
            run(&mut timeline);
        }
        for pair in handled.windows(2) {
            prop_assert!(pair[1].0.time.since(pair[0].0.time) >= 10.ns());
        }
        let mut values: Vec<_> = handled.iter().map(|(_, value)| *value).chain(released.clone()).collect();
        values.sort_unstable();
        prop_assert_eq!(values, (0..wanted.len()).collect::<Vec<_>>());
        match policy {
            SpacingPolicy::Defer => prop_assert!(released.is_empty()),
            SpacingPolicy::Drop => for (tag, value) in &handled {
                prop_assert!(tag.time.as_nanos() <= wanted[*value].max(0) + 1);
            },
            SpacingPolicy::Replace => {
                prop_assert_eq!(handled.last().unwrap().1, wanted.len() - 1);
                prop_assert!(handled.last().unwrap().0.time.as_nanos() <= now + 10);
            }
        }
    }
}
