//! Who a certificate is made out to.

use std::fmt;

/// What every name ends with.
const DOMAIN: &str = "ictus";

/// A member of a federation.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub enum Member {
    /// The coordinator.
    Rti,
    /// The federate with this id.
    Federate(u16),
}

impl Member {
    /// The name in its certificate: `rti.RUN.ictus` or `f3.RUN.ictus`; no two members of any two runs share one.
    pub(crate) fn name(self, run: &str) -> String {
        match self {
            Self::Rti => format!("rti.{run}.{DOMAIN}"),
            Self::Federate(id) => format!("f{id}.{run}.{DOMAIN}"),
        }
    }

    /// The member and the run of a name; nothing when it is none of ours.
    pub(crate) fn of_name(name: &str) -> Option<(Self, &str)> {
        let (first, rest) = name.split_once('.')?;
        let run = rest.strip_suffix(DOMAIN)?.strip_suffix('.')?;
        let member = match first {
            "rti" => Self::Rti,
            _ => {
                let digits = first.strip_prefix('f')?;
                let id = digits
                    .parse()
                    .ok()
                    .filter(|id: &u16| id.to_string() == digits);
                Self::Federate(id?)
            }
        };
        (!run.is_empty() && !run.contains('.')).then_some((member, run))
    }
}

impl fmt::Display for Member {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Rti => f.write_str("the RTI"),
            Self::Federate(id) => write!(f, "federate {id}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_name_says_who_it_is(id: Option<u16>, run in "[0-9a-z]{1,32}") {
            let member = id.map_or(Member::Rti, Member::Federate);
            let name = member.name(&run);
            prop_assert_eq!(Member::of_name(&name), Some((member, run.as_str())));
        }

        #[test]
        fn any_text_is_read(text: String) {
            if let Some((member, run)) = Member::of_name(&text) {
                prop_assert_eq!(member.name(run), text);
            }
        }
    }

    #[test]
    fn other_names_are_nobody() {
        for name in [
            "f3",
            "f3.ictus",
            "f03.run.ictus",
            "f+3.run.ictus",
            "f70000.run.ictus",
            "g3.run.ictus",
            "f3..ictus",
            "f3.a.b.ictus",
            "f3.run.org",
        ] {
            assert_eq!(Member::of_name(name), None, "{name}");
        }
    }
}
