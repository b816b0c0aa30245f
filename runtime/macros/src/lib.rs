//! The attribute layer over the Ictus program builder: `#[reactor]`, `#[reactions]`, `#[derive(Value)]`.
//!
//! Documented where users find them: in the crate `ictus`.

#![expect(
    clippy::wildcard_enum_match_arm,
    reason = "the enums matched are mostly syn's, which are large and grow"
)]

mod options;
mod reactions;
mod reactor;
mod value;

use proc_macro::TokenStream;

/// Splits a struct into parameters and state, which stay, and parts (ports, timers, actions, children).
///
/// What a field is follows from its type and attribute:
///
/// | field | is |
/// |---|---|
/// | `#[param(default = 100.ms())] period: Duration` | a parameter; without `default` it must be given |
/// | `input: Input<T>`, `out: Output<T>` | a port |
/// | `#[width = n] ins: Multi<Input<T>>` | a multiport of `n` channels |
/// | `#[timer(offset = 1.ms(), period = period)] tick: Timer` | a timer; without a period it fires once |
/// | `#[action(min_delay = 5.ms())] later: LogicalAction<T>` | a logical action |
/// | `#[action(min_delay = 5.ms())] key: PhysicalAction<T>` | a physical action |
/// | `#[action(min_spacing = 1.ms(), policy = drop)] key: PhysicalAction<T>` | an action with a least span between events: one that comes too soon is put off (`defer`, the default), is lost (`drop`), or gives its value to the event that still waits (`replace`) |
/// | `#[watchdog(timeout = 100.ms())] guard: Watchdog` | a watchdog |
/// | `#[child(Stage { gain: 2 })] first: Child<Stage>` | a nested reactor with its parameters |
/// | `#[child(\|i\| Stage { gain: i })] #[width = n] stages: Bank<Stage>` | a bank of nested reactors |
/// | `#[bank_index] index: usize` | the reactor's index in its bank |
/// | `#[state(init = Vec::with_capacity(size))] items: Vec<u8>` | state with a first value |
/// | `count: u64` | state that begins with its default |
///
/// Expressions may name parameters and the bank index.
#[proc_macro_attribute]
pub fn reactor(attributes: TokenStream, item: TokenStream) -> TokenStream {
    reactor::expand(attributes.into(), item.into())
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}

/// Declares reactions and connections by their signatures.
///
/// Each `#[reaction]` method is a reaction; the order in the block is the order at one tag. Its arguments name parts:
///
/// | argument | means |
/// |---|---|
/// | `tick: &Timer`, `input: &Input<T>`, `later: &LogicalAction<T>` | a trigger, which may be read |
/// | `_: &Startup`, `_: &Shutdown` | a trigger: the first tag, the last tag |
/// | `#[uses] input: &Input<T>` | read without being a trigger |
/// | `out: &mut Output<T>`, `later: &mut LogicalAction<T>` | may be set, may be scheduled |
/// | `#[trigger] later: &mut LogicalAction<T>` | a trigger that may be scheduled again |
/// | `key: &mut PhysicalAction<T>` | may be scheduled, by the physical clock |
/// | `guard: &mut Watchdog` | may be started and stopped |
/// | `#[of(first.out)] value: &Input<T>` | a child's output, as a trigger |
/// | `#[of(first.input)] value: &mut Output<T>` | a child's input, to be set |
/// | `ctx: &mut Ctx` | the context: tag, clock, log |
///
/// A leading underscore is not part of the name: `_tick: &Timer`. `#[reaction(deadline = 5.ms(), late = Self::too_late)]`
/// runs `too_late` with the same arguments instead when the reaction starts more than 5 ms after its tag's time.
///
/// `#[reaction(stp = Self::tardy)]` runs `tardy` with the same arguments instead when a message that led to the reaction was
/// tardy (decentralized coordination); `ctx.intended()` is the tag at which it should have run. Both may be given; a
/// tardy reaction runs its STP handler also when it is late.
///
/// `#[watchdog(guard)] fn silent(&mut self, ctx: &mut Ctx, alarm: &mut PhysicalAction<T>)` runs when the watchdog `guard`
/// expires, at a physical time, also when no tag advances: it changes state, schedules physical actions, and may ask for a
/// stop. Every watchdog has one such method.
///
/// One method may be `#[connections]`: it takes `&mut Wiring` and the parts that it connects by `&`.
#[proc_macro_attribute]
pub fn reactions(attributes: TokenStream, item: TokenStream) -> TokenStream {
    reactions::expand(attributes.into(), item.into())
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}

/// Makes a type a value that ports and actions carry.
///
/// `#[value(native)]` offers the fixed-layout serializer (all fields must be plain old data), `#[value(postcard)]`
/// postcard (the type must be `serde::Serialize` and `serde::Deserialize`); both may be given.
#[proc_macro_derive(Value, attributes(value))]
pub fn value(item: TokenStream) -> TokenStream {
    value::expand(item.into())
        .unwrap_or_else(syn::Error::into_compile_error)
        .into()
}
