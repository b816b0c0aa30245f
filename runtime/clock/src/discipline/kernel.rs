//! What the kernel knows of its clock: adjtimex(2), read only.

use ictus_coord::report::ClockSource;
use ictus_core::Duration;
use nix::libc;

use super::Discipline;

/// What the kernel says; `None` when it does not answer.
#[expect(
    unsafe_code,
    reason = "no crate has a safe wrapper that gives maxerror"
)]
pub(super) fn read() -> Option<Discipline> {
    // SAFETY: a timex is integers only, for which zeros are values; modes 0 changes nothing, and the pointer is to our own.
    let (state, timex) = unsafe {
        let mut timex: libc::timex = std::mem::zeroed();
        (libc::adjtimex(&raw mut timex), timex)
    };
    (state >= 0).then(|| judge(state, timex.status, timex.maxerror))
}

fn judge(state: i32, status: i32, maxerror_us: i64) -> Discipline {
    Discipline {
        source: ClockSource::Kernel,
        offset: Duration::ZERO,
        bound: Duration::from_micros(maxerror_us.max(0)),
        synchronized: state != libc::TIME_ERROR && status & libc::STA_UNSYNC == 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernel_answers_anybody() {
        let kernel = read().unwrap();
        assert_eq!(kernel.source, ClockSource::Kernel);
        assert!(kernel.bound >= Duration::ZERO);
    }

    #[test]
    fn an_unsynchronized_clock_says_so() {
        // Unsynchronized hosts: TIME_ERROR, STA_UNSYNC, 16 s.
        let host = judge(libc::TIME_ERROR, libc::STA_UNSYNC, 16_000_000);
        assert!(!host.synchronized && host.bound == Duration::from_secs(16));
        let host = judge(libc::TIME_OK, libc::STA_PLL | libc::STA_NANO, 1_500);
        assert!(host.synchronized && host.bound == Duration::from_micros(1_500));
    }
}
