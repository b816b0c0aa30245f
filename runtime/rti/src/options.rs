//! The command line of LF's RTI, parsed by hand: its options have one dash, long names and several values.

use std::ffi::OsString;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;

use ictus_clock::Stamps;
use ictus_coord::plan::{FAILURE_TIMEOUT, Wire};
use ictus_coord::rti::RtiConfig;
use ictus_core::Duration;

/// LF's default port.
pub const DEFAULT_PORT: u16 = 15045;
/// LF's default federation id.
pub const DEFAULT_FEDERATION: &str = "Unidentified Federation";
/// LF's default number of clock exchanges; compiled into its federates.
const DEFAULT_EXCHANGES: u32 = 10;
/// LF's default time between two exchanges.
const DEFAULT_PERIOD: Duration = Duration::from_millis(10);
/// LF's launchers write this where an option is left out; LF's RTI skips it.
const BLANK: &str = " ";
/// A payload's length is a signed 32-bit number on the wire.
const LONGEST_PAYLOAD: u32 = i32::MAX.cast_unsigned();
const FEDERATE_IDS: &str = "ids of federates, below `-n`, with commas between them";
/// A terabyte: no output queue is longer.
const LARGEST_OUTPUT: u64 = 1 << 40;

const HELP: &str = "\
Usage: ictus rti -n N [OPTION]...
Coordinates one federation; takes the options of Lingua Franca's RTI.

  -n, --number_of_federates N   how many federates join (required)
  -i, --id ID                   the federation's id
  -p, --port PORT               TCP port (default 15045; 0: any free one)
      --bind ADDRESS            address to listen on (default 127.0.0.1, for this host alone; LF's RTI:
                                0.0.0.0, for all)
  -a, --auth                    only federates join that prove to know the federation's id (HMAC)
  -c, --clock_sync off|init|initial|on [period NS] [exchanges-per-interval K]
                                compare clocks while federates join, `on`: and every period from then on
                                (default off; 10 ms; 10 exchanges)
      --allow IPv4[,IPv4]...    take connections only from these addresses (default: from all)
      --clock-port PORT         UDP port for that (default 0: any free one; LF's RTI: 15061)
      --clock-stamps kernel|reader
                                who says when a datagram came (default kernel)
  -d, --dnet_disabled           send no downstream next event tags
  -m, --start-time-multiple VALUE UNIT
                                round the start time up to a multiple; units from ns to weeks
      --continue ID[,ID]...     go on when one of these federates is lost: as if it had resigned
      --failure-timeout MS      how long another host may answer nothing at all before its federates count
                                as lost, in milliseconds from 1000 to 3600000 (default 10000)
      --join-timeout MS         give up when they have not all joined after so many milliseconds
      --max-payload SIZE        the longest payload of one message, in bytes or with K, M or G
                                (default 64M); a longer one fails its sender; Ictus programs
                                themselves take no longer ones than 64M
      --max-output SIZE         the most that may wait for one federate (default 256M); more ends the
                                federation
      --wire 0.12|0.13          the layout of address queries: LF's to 0.12 (default), or from 0.13 on
      --tls DIRECTORY           take federates only with certificates of this run, as `ictus up` makes them:
                                authority.pem, certificate.pem and key.pem there
      --status-fd FD            write one JSON object a line to this inherited descriptor
  -v, --version
  -h, --help";

/// What a command line asks for.
#[derive(Debug)]
pub enum Command {
    /// To run an RTI.
    Run(Box<Options>),
    /// To print this and exit.
    Print(String),
}

/// How an RTI is to run.
#[derive(Clone, Debug)]
pub struct Options {
    /// What the state machine is told.
    pub config: RtiConfig,
    /// The address to listen on.
    pub bind: IpAddr,
    /// From where connections are taken; empty: from everywhere.
    pub allow: Vec<Ipv4Addr>,
    /// Where certificate and key are; absent: connections are in the clear.
    pub tls: Option<PathBuf>,
    /// Whether nobody chose that address.
    pub bind_is_default: bool,
    /// How long another host may answer nothing at all.
    pub failure_timeout: Duration,
    /// The TCP port to listen on; 0: the system chooses one.
    pub port: u16,
    /// How long federates may take to join, from when the RTI listens; absent: for ever.
    pub join_timeout: Option<std::time::Duration>,
    /// The UDP port from which clocks are compared; 0: the system chooses one.
    pub clock_port: u16,
    /// Who says when a datagram came.
    pub stamps: Stamps,
    /// The inherited descriptor for status lines.
    pub status_fd: Option<u32>,
    /// What was asked for and is done differently, for people.
    pub warnings: Vec<String>,
}

/// Why a command line makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum UsageError {
    /// An option that no RTI has.
    #[error("unknown option `{0}`; see `ictus rti --help`")]
    Unknown(String),
    /// An option of LF's RTI that this one does not have.
    #[error("`{option}` is not supported: {why}")]
    Unsupported {
        /// The option.
        option: String,
        /// What is missing.
        why: &'static str,
    },
    /// An option stands last without its value.
    #[error("`{0}` needs a value")]
    Missing(String),
    /// A value is not one that the option takes.
    #[error("`{option}` takes {expected}, not `{value}`")]
    Invalid {
        /// The option.
        option: String,
        /// What it takes, in words.
        expected: &'static str,
        /// What it was given.
        value: String,
    },
    /// The number of federates is not given.
    #[error("`-n N` is missing: how many federates join?")]
    NumberMissing,
    /// An argument is not Unicode.
    #[error("argument `{0}` is not valid Unicode")]
    NotUnicode(String),
}

impl Options {
    /// The defaults for a federation of `federates` federates on a free port of the loopback interface.
    #[must_use]
    pub fn new(federation: &str, federates: u16) -> Self {
        Self {
            config: RtiConfig::new(federation, federates),
            bind: IpAddr::V4(Ipv4Addr::LOCALHOST),
            allow: Vec::new(),
            tls: None,
            bind_is_default: true,
            failure_timeout: FAILURE_TIMEOUT,
            port: 0,
            join_timeout: None,
            clock_port: 0,
            stamps: Stamps::Kernel,
            status_fd: None,
            warnings: Vec::new(),
        }
    }

    /// Parses a command line (without the program's name).
    ///
    /// LF's parser swallows the option that follows the values of `-c`; this one does not.
    ///
    /// # Errors
    ///
    /// When an option is unknown, unsupported or has a wrong value, or the number of federates is missing.
    pub fn parse(arguments: impl IntoIterator<Item = OsString>) -> Result<Command, UsageError> {
        let arguments: Vec<String> = arguments
            .into_iter()
            .map(|argument| {
                argument
                    .into_string()
                    .map_err(|argument| UsageError::NotUnicode(argument.display().to_string()))
            })
            .collect::<Result<_, _>>()?;
        let mut parser = Parser {
            arguments: arguments.into_iter().peekable(),
            options: Self {
                port: DEFAULT_PORT,
                ..Self::new(DEFAULT_FEDERATION, 0)
            },
        };
        while let Some(option) = parser.arguments.next() {
            if let Some(text) = parser.take(&option)? {
                return Ok(Command::Print(text));
            }
        }
        let config = &parser.options.config;
        if config.federates == 0 {
            return Err(UsageError::NumberMissing);
        }
        let stranger = config.continue_without.last();
        if let Some(id) = stranger.filter(|&&id| id >= config.federates) {
            return invalid("--continue", FEDERATE_IDS, id.to_string());
        }
        Ok(Command::Run(Box::new(parser.options)))
    }
}

struct Parser {
    arguments: std::iter::Peekable<std::vec::IntoIter<String>>,
    options: Options,
}

impl Parser {
    /// Takes one option with its values; gives a text when only that is wanted.
    fn take(&mut self, option: &str) -> Result<Option<String>, UsageError> {
        match option {
            // LF's launchers leave empty places.
            BLANK => {}
            "-i" | "--id" => self.options.config.federation = self.federation(option)?,
            "-n" | "--number_of_federates" => {
                self.options.config.federates = self.number_of_federates(option)?;
            }
            "-p" | "--port" => self.options.port = self.number(option, "a port (0 to 65535)")?,
            "--bind" => {
                self.options.bind = self.number(option, "an IP address")?;
                self.options.bind_is_default = false;
            }
            "-c" | "--clock_sync" => self.clock_sync(option)?,
            "-a" | "--auth" => self.options.config.authentication = true,
            "--continue" => self.continue_without(option)?,
            "--allow" => self.allow(option)?,
            "--join-timeout" => {
                let ms = self.number(option, "a number of milliseconds")?;
                self.options.join_timeout = Some(std::time::Duration::from_millis(ms));
            }
            "--clock-port" => {
                self.options.clock_port = self.number(option, "a port (0 to 65535)")?;
            }
            "--clock-stamps" => self.options.stamps = self.stamps(option)?,
            "--tls" => self.options.tls = Some(self.value(option)?.into()),
            "-d" | "--dnet_disabled" => self.options.config.dnet = false,
            "-m" | "--start-time-multiple" => {
                self.options.config.start_multiple = Some(self.multiple(option)?);
            }
            "--failure-timeout" => {
                let expected = "milliseconds from 1000 (1 s) to 3600000 (an hour)";
                self.options.failure_timeout = match self.number(option, expected)? {
                    ms @ 1_000..=3_600_000 => Duration::from_millis(ms),
                    ms => return invalid(option, expected, ms.to_string()),
                };
            }
            "--max-payload" => {
                let size = self.size(option, u64::from(LONGEST_PAYLOAD))?;
                self.options.config.max_payload = u32::try_from(size).unwrap_or(LONGEST_PAYLOAD);
            }
            "--max-output" => {
                let size = self.size(option, LARGEST_OUTPUT)?;
                self.options.config.max_output = usize::try_from(size).unwrap_or(usize::MAX);
            }
            "--wire" => self.options.config.wire = self.wire(option)?,
            "--status-fd" => {
                self.options.status_fd = Some(self.number(option, "a descriptor's number")?);
            }
            "-t" | "--tracing" => {
                self.options
                    .warnings
                    .push("tracing is not supported: `-t` is ignored".to_owned());
            }
            "-v" | "--version" => {
                return Ok(Some(format!("ictus rti {}", env!("CARGO_PKG_VERSION"))));
            }
            "-h" | "--help" => return Ok(Some(HELP.to_owned())),
            "-tls" => return unsupported(option, "it has no TLS of LF's; see `--tls`"),
            "-sst" => return unsupported(option, "there is no SST"),
            "-nt" => return unsupported(option, "there are no transient federates"),
            _ => return Err(UsageError::Unknown(option.to_owned())),
        }
        Ok(None)
    }

    fn value(&mut self, option: &str) -> Result<String, UsageError> {
        self.arguments
            .next()
            .ok_or_else(|| UsageError::Missing(option.to_owned()))
    }

    fn number<T: std::str::FromStr>(
        &mut self,
        option: &str,
        expected: &'static str,
    ) -> Result<T, UsageError> {
        let value = self.value(option)?;
        value.parse().or_else(|_| invalid(option, expected, value))
    }

    /// A number of bytes from 1 to `most`, with a unit of 1024, its square or its cube.
    fn size(&mut self, option: &str, most: u64) -> Result<u64, UsageError> {
        let value = self.value(option)?;
        let (digits, unit) = match value.strip_suffix(['K', 'k', 'M', 'm', 'G', 'g']) {
            Some(digits) => (digits, value[digits.len()..].to_ascii_uppercase()),
            None => (value.as_str(), String::new()),
        };
        let unit: u64 = match unit.as_str() {
            "K" => 1 << 10,
            "M" => 1 << 20,
            "G" => 1 << 30,
            _ => 1,
        };
        let number = digits.parse().ok().filter(|_| !digits.starts_with('+'));
        number
            .and_then(|number: u64| number.checked_mul(unit))
            .filter(|size| (1..=most).contains(size))
            .map_or_else(
                || {
                    invalid(
                        option,
                        "a size in bytes, such as 1000, 64K, 64M or 1G",
                        value.clone(),
                    )
                },
                Ok,
            )
    }

    fn federation(&mut self, option: &str) -> Result<String, UsageError> {
        let value = self.value(option)?;
        if value.len() > usize::from(u8::MAX) {
            return invalid(option, "at most 255 bytes", value);
        }
        Ok(value)
    }

    fn number_of_federates(&mut self, option: &str) -> Result<u16, UsageError> {
        let expected = "a number from 1 to 65534";
        match self.number(option, expected)? {
            number @ (0 | u16::MAX) => invalid(option, expected, number.to_string()),
            number => Ok(number),
        }
    }

    fn allow(&mut self, option: &str) -> Result<(), UsageError> {
        let value = self.value(option)?;
        for address in value.split(',') {
            let Ok(address) = address.trim().parse() else {
                return invalid(option, "IPv4 addresses with commas between them", value);
            };
            self.options.allow.push(address);
        }
        Ok(())
    }

    fn continue_without(&mut self, option: &str) -> Result<(), UsageError> {
        let value = self.value(option)?;
        for id in value.split(',') {
            let Ok(id) = id.trim().parse() else {
                return invalid(option, FEDERATE_IDS, value);
            };
            self.options.config.continue_without.insert(id);
        }
        Ok(())
    }

    fn clock_sync(&mut self, option: &str) -> Result<(), UsageError> {
        let mode = self.value(option)?;
        let mut exchanges = DEFAULT_EXCHANGES;
        let mut period = DEFAULT_PERIOD;
        while let Some(key) = self
            .arguments
            .next_if(|word| matches!(word.as_str(), "period" | "exchanges-per-interval" | BLANK))
        {
            match key.as_str() {
                BLANK => {}
                "period" => period = self.period(&key)?,
                _ => exchanges = self.number(&key, "a number")?,
            }
        }
        self.options.config.clock_period = (mode == "on").then_some(period);
        self.options.config.clock_exchanges = match mode.as_str() {
            "off" => 0,
            "init" | "initial" | "on" => exchanges,
            _ => return invalid(option, "off, init, initial or on", mode),
        };
        Ok(())
    }

    fn wire(&mut self, option: &str) -> Result<Wire, UsageError> {
        let value = self.value(option)?;
        match value.as_str() {
            "0.12" => Ok(Wire::V0_12),
            "0.13" => Ok(Wire::V0_13),
            _ => invalid(option, "0.12 or 0.13", value),
        }
    }

    fn period(&mut self, option: &str) -> Result<Duration, UsageError> {
        let expected = "nanoseconds, from 100000 (100 us) to 60000000000 (a minute)";
        match self.number(option, expected)? {
            nanos @ 100_000..=60_000_000_000 => Ok(Duration::from_nanos(nanos)),
            nanos => invalid(option, expected, nanos.to_string()),
        }
    }

    fn stamps(&mut self, option: &str) -> Result<Stamps, UsageError> {
        let value = self.value(option)?;
        match value.as_str() {
            "kernel" => Ok(Stamps::Kernel),
            "reader" => Ok(Stamps::Reader),
            _ => invalid(option, "kernel or reader", value),
        }
    }

    fn multiple(&mut self, option: &str) -> Result<Duration, UsageError> {
        let value: i64 = self.number(option, "a number and a unit")?;
        let unit = self.value(option)?;
        let nanos = match unit.as_str() {
            "ns" | "nsec" | "nsecs" => 1,
            "us" | "usec" | "usecs" => 1_000,
            "ms" | "msec" | "msecs" => 1_000_000,
            "s" | "sec" | "secs" | "second" | "seconds" => 1_000_000_000,
            "min" | "mins" | "minute" | "minutes" => 60_000_000_000,
            "h" | "hour" | "hours" => 3_600_000_000_000,
            "d" | "day" | "days" => 24 * 3_600_000_000_000,
            "week" | "weeks" => 7 * 24 * 3_600_000_000_000,
            _ => return invalid(option, "a unit (ns, us, ms, s, min, hour, day, week)", unit),
        };
        match value.checked_mul(nanos) {
            Some(nanos) if nanos > 0 => Ok(Duration::from_nanos(nanos)),
            Some(_) | None => invalid(option, "a positive time", format!("{value} {unit}")),
        }
    }
}

fn unsupported<T>(option: &str, why: &'static str) -> Result<T, UsageError> {
    Err(UsageError::Unsupported {
        option: option.to_owned(),
        why,
    })
}

fn invalid<T>(option: &str, expected: &'static str, value: String) -> Result<T, UsageError> {
    Err(UsageError::Invalid {
        option: option.to_owned(),
        expected,
        value,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn certificates_are_in_a_directory() {
        let options = parse("-n 1 --tls /run/ictus/rti").unwrap();
        assert_eq!(options.tls.as_deref(), Some("/run/ictus/rti".as_ref()));
        assert_eq!(parse("-n 1").unwrap().tls, None);
    }

    fn parse(line: &str) -> Result<Options, UsageError> {
        match Options::parse(line.split_whitespace().map(OsString::from))? {
            Command::Run(options) => Ok(*options),
            Command::Print(text) => panic!("{text}"),
        }
    }

    #[test]
    fn the_launchers_line() {
        let options = parse("-i 3fa9 -n 4 -c init exchanges-per-interval 10").unwrap();
        assert_eq!(options.config.federation, "3fa9");
        assert_eq!(options.config.federates, 4);
        assert_eq!(options.config.clock_exchanges, 10);
        assert_eq!(options.port, DEFAULT_PORT);
        assert!(options.config.dnet);
    }

    #[test]
    fn the_option_after_the_clock_counts() {
        let options = parse("-c off -d -n 1").unwrap();
        assert_eq!(options.config.clock_exchanges, 0);
        assert!(!options.config.dnet);
        let options = parse("-n 1 -c on period 5000000 exchanges-per-interval 3 -d").unwrap();
        assert_eq!(options.config.clock_exchanges, 3);
        assert!(!options.config.dnet);
        assert_eq!(options.config.clock_period, Some(Duration::from_millis(5)));
        assert_eq!(options.warnings.len(), 0);
        let options = parse("-n 1 -c on --clock-port 15061").unwrap();
        assert_eq!(options.config.clock_period, Some(Duration::from_millis(10)));
        assert_eq!(
            (options.clock_port, options.stamps),
            (15_061, Stamps::Kernel)
        );
        let options = parse("-n 1 -c init period 5000000 --clock-stamps reader").unwrap();
        assert_eq!(options.config.clock_period, None);
        assert_eq!(options.stamps, Stamps::Reader);
    }

    #[test]
    fn long_names_and_ours() {
        let options =
            parse("--number_of_federates 2 --port 0 --bind 0.0.0.0 --status-fd 3 -m 2 sec")
                .unwrap();
        assert_eq!((options.port, options.status_fd), (0, Some(3)));
        assert_eq!(options.bind, IpAddr::V4(Ipv4Addr::UNSPECIFIED));
        assert!(!options.bind_is_default && parse("-n 1").unwrap().bind_is_default);
        assert_eq!(options.config.start_multiple, Some(Duration::from_secs(2)));
    }

    #[test]
    fn what_lf_takes() {
        let hours = 3600;
        let units = [
            ("1 hour", hours),
            ("2 hours", 2 * hours),
            ("1 day", 24 * hours),
            ("2 days", 48 * hours),
            ("1 week", 168 * hours),
            ("2 weeks", 336 * hours),
        ];
        for (multiple, seconds) in units {
            let options = parse(&format!("-n 1 -m {multiple}")).unwrap();
            let expected = Some(Duration::from_secs(seconds));
            assert_eq!(options.config.start_multiple, expected, "{multiple}");
        }
        assert_eq!(parse("-n 1 -c initial").unwrap().config.clock_exchanges, 10);
        let line = " |-n|2| |-c|init| |exchanges-per-interval|4| |-d| ";
        let arguments = line.split('|').map(OsString::from);
        let Ok(Command::Run(options)) = Options::parse(arguments) else {
            panic!("blanks are skipped");
        };
        assert_eq!(options.config.federates, 2);
        assert_eq!(options.config.clock_exchanges, 4);
        assert!(!options.config.dnet);
    }

    #[test]
    fn the_layout_is_chosen() {
        let wire = |line: &str| parse(line).unwrap().config.wire;
        assert_eq!(wire("-n 1"), Wire::V0_12);
        assert_eq!(wire("-n 1 --wire 0.13"), Wire::V0_13);
        assert_eq!(wire("-n 1 --wire 0.12"), Wire::V0_12);
        let error = parse("-n 1 --wire 0.11").unwrap_err().to_string();
        assert_eq!(error, "`--wire` takes 0.12 or 0.13, not `0.11`");
    }

    #[test]
    fn who_may_fail_and_who_joins() {
        let options = parse("--continue 2,0 -n 3 --continue 1 -c off -a").unwrap();
        assert!(options.config.continue_without.iter().eq(&[0, 1, 2]));
        assert!(options.config.authentication);
        let config = parse("-n 1").unwrap().config;
        assert!(!config.authentication && config.continue_without.is_empty());
    }

    #[test]
    fn hosts_may_be_silent_for_so_long() {
        let timeout = |line: &str| parse(line).unwrap().failure_timeout;
        assert_eq!(timeout("-n 1"), FAILURE_TIMEOUT);
        let line = "-n 1 --failure-timeout 3000";
        assert_eq!(timeout(line), Duration::from_secs(3));
    }

    #[test]
    fn limits_are_sizes() {
        let sizes = |line: &str| {
            let config = parse(line).unwrap().config;
            (config.max_payload, config.max_output)
        };
        assert_eq!(sizes("-n 1"), (64 << 20, 256 << 20));
        let line = "-n 1 --max-payload 1000 --max-output 3G";
        assert_eq!(sizes(line), (1000, 3 << 30));
        let line = "-n 1 --max-payload 4k --max-output 1M";
        assert_eq!(sizes(line), (4096, 1 << 20));
    }

    #[test]
    fn mistakes_are_named() {
        let table = [
            ("", "`-n N` is missing: how many federates join?"),
            ("-n 0", "`-n` takes a number from 1 to 65534, not `0`"),
            ("-n x", "`-n` takes a number from 1 to 65534, not `x`"),
            ("-n", "`-n` needs a value"),
            (
                "-n 1 -c sometimes",
                "`-c` takes off, init, initial or on, not `sometimes`",
            ),
            (
                "-n 3 --continue 1,3",
                "`--continue` takes ids of federates, below `-n`, with commas between them, not `3`",
            ),
            (
                "-n 3 --allow 10.0.0.1,pi",
                "`--allow` takes IPv4 addresses with commas between them, not `10.0.0.1,pi`",
            ),
            (
                "-n 3 --continue 1,",
                "`--continue` takes ids of federates, below `-n`, with commas between them, not `1,`",
            ),
            (
                "-n 1 -c on period 5",
                "`period` takes nanoseconds, from 100000 (100 us) to 60000000000 (a minute), not `5`",
            ),
            (
                "-n 1 --failure-timeout 999",
                "`--failure-timeout` takes milliseconds from 1000 (1 s) to 3600000 (an hour), not `999`",
            ),
            (
                "-n 1 -nt 2",
                "`-nt` is not supported: there are no transient federates",
            ),
            (
                "-n 1 --wat",
                "unknown option `--wat`; see `ictus rti --help`",
            ),
            (
                "-n 1 -p 70000",
                "`-p` takes a port (0 to 65535), not `70000`",
            ),
            (
                "-n 1 --max-output 0",
                "`--max-output` takes a size in bytes, such as 1000, 64K, 64M or 1G, not `0`",
            ),
            (
                "-n 1 --max-payload 2G",
                "`--max-payload` takes a size in bytes, such as 1000, 64K, 64M or 1G, not `2G`",
            ),
            (
                "-n 1 --max-payload M",
                "`--max-payload` takes a size in bytes, such as 1000, 64K, 64M or 1G, not `M`",
            ),
            (
                "-n 1 -m 1 fortnight",
                "`-m` takes a unit (ns, us, ms, s, min, hour, day, week), not `fortnight`",
            ),
            ("-n 1 -m 0 ms", "`-m` takes a positive time, not `0 ms`"),
        ];
        for (line, expected) in table {
            assert_eq!(parse(line).unwrap_err().to_string(), expected);
        }
    }
}
