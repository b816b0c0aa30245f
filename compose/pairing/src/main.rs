//! A localizer at 30 Hz, a planner that needs 75 ms, and a controller that must see the state that was planned from.
//!
//! Source: Xronos, arXiv 2207.09555, Section III-B (multi-node inconsistency).

use ictus::prelude::*;
use std::time::Instant;

/// Where the vehicle is.
#[derive(Clone, Copy, Debug, PartialEq, Value)]
#[value(native)]
pub struct State {
    /// Counts states from 1.
    number: u64,
    /// Along the road, in metres.
    position: f64,
}

/// Where the vehicle shall go.
#[derive(Clone, Copy, Debug, PartialEq, Value)]
#[value(native)]
pub struct Trajectory {
    /// The number of the state that it begins at.
    planned_from: u64,
    /// Along the road, in metres.
    target: f64,
}

/// What the controller did.
#[derive(Clone, Copy, Debug, PartialEq, Value)]
#[value(native)]
pub struct Control {
    /// The state and the trajectory that were used.
    state: u64,
    planned_from: u64,
    /// Metres that are left.
    left: f64,
}

/// Says the kinematic state every period.
#[reactor]
pub struct Localizer {
    #[param(default = 33_333_333.ns())]
    period: Duration,
    #[timer(period = period)]
    tick: Timer,
    state: Output<State>,
    last: u64,
    position: f64,
}

#[reactions]
impl Localizer {
    #[reaction]
    fn tick(&mut self, _tick: &Timer, state: &mut Output<State>) {
        self.last += 1;
        self.position += 0.5;
        state.set(State {
            number: self.last,
            position: self.position,
        });
    }
}

/// Plans from every n-th state, for there is no time for more.
#[reactor]
pub struct Planner {
    #[param(default = 3)]
    every: u64,
    #[param(default = 75.ms())]
    work: Duration,
    state: Input<State>,
    trajectory: Output<Trajectory>,
}

#[reactions]
impl Planner {
    #[reaction]
    fn plan(&mut self, state: &Input<State>, trajectory: &mut Output<Trajectory>) {
        let Some(state) = state.get() else { return };
        if (state.number - 1).is_multiple_of(self.every) {
            busy(self.work);
            trajectory.set(Trajectory {
                planned_from: state.number,
                target: state.position + 20.0,
            });
        }
    }
}

/// Controls with a trajectory and the state of the same tag, and counts the pairs that do not match.
#[reactor]
pub struct Controller {
    state: Input<State>,
    trajectory: Input<Trajectory>,
    control: Output<Control>,
    pairs: u64,
    mismatches: u64,
}

#[reactions]
impl Controller {
    #[reaction]
    fn control(
        &mut self,
        trajectory: &Input<Trajectory>,
        #[uses] state: &Input<State>,
        control: &mut Output<Control>,
    ) {
        let Some(trajectory) = trajectory.get() else {
            return;
        };
        let now = state.get().copied();
        self.pairs += 1;
        if let Some(state) = now.filter(|state| state.number == trajectory.planned_from) {
            control.set(Control {
                state: state.number,
                planned_from: trajectory.planned_from,
                left: trajectory.target - state.position,
            });
        } else {
            self.mismatches += 1;
        }
    }

    #[reaction]
    fn report(&mut self, ctx: &mut Ctx, _: &Shutdown) {
        log!(
            ctx,
            "{} mismatches in {} pairs",
            self.mismatches,
            self.pairs
        );
    }
}

/// Occupies the processor for a physical time.
fn busy(work: Duration) {
    let start = Instant::now();
    while start.elapsed() < work.to_std() {
        std::hint::spin_loop();
    }
}

ictus::program![Localizer, Planner, Controller];

#[cfg(test)]
mod tests {
    use super::*;
    use ictus::simulate::Federation;
    use serde_json::json;

    /// Stops the test at the first wrong pair; it hears of every right one.
    #[reactor]
    struct Judge {
        control: Input<Control>,
        heard: u64,
    }

    #[reactions]
    impl Judge {
        #[reaction]
        fn judge(&mut self, control: &Input<Control>) {
            let control = control.get().unwrap();
            assert_eq!(control.state, control.planned_from);
            assert_eq!(control.planned_from, 3 * self.heard + 1, "none is left out");
            self.heard += 1;
        }
    }

    #[test]
    fn the_controller_sees_matching_pairs_whatever_the_network_does() {
        let plan = Some(100.ms());
        let federation = Federation::new()
            .federate::<Localizer>("localizer", json!({}))
            .federate::<Planner>("planner", json!({"work": "0 ms"}))
            .federate::<Controller>("controller", json!({}))
            .federate::<Judge>("judge", json!({}))
            .connect("localizer.state", "planner.state", None)
            .connect("localizer.state", "controller.state", plan)
            .connect("planner.trajectory", "controller.trajectory", plan)
            .connect("controller.control", "judge.control", None)
            .timeout(2.secs());
        let alone = federation.alone().unwrap();
        // States are taken at 0, 33, 67, ... ms; the 20 plans of the first 1.9 s arrive.
        assert_eq!(alone.of("judge").count(), 20, "{alone}");
        for seed in 0..30 {
            assert_eq!(federation.simulate(seed).unwrap(), alone, "seed {seed}");
        }
        let decentralized = federation.decentralized(60.secs());
        for seed in 0..5 {
            assert_eq!(decentralized.simulate(seed).unwrap(), alone, "seed {seed}");
        }
    }
}
