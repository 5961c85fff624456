"""A fleet on the live screen: a line for each environment, and as much of the rest as fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from launcher import drawing, panes
from launcher.drawing import ACCENT, LABEL
from launcher.panes import STATE_STYLE, WIDTH, Now
from rtcore import cast
from rtcore.cast import role_of
from rtcore.channels import AGENT, ENV_SERVER
from rtcore.config import RunConfig
from rtcore.messages import Event

SHORT = {ENV_SERVER: "env", AGENT: "agent"}  # where a line has both
QUANTILES = ("p50", "p99", "p999", "max")
CURVE = 12  # episodes whose returns are drawn in an environment's line, where there is room
BORDER, PROGRESS, MIDDLE, HEAD, LEARNING, CAUSES = 2, 1, 4, 2, 2, 1  # lines


@dataclass(frozen=True)
class Layout:
    """What of the screen is shown.

    Attributes:
        log: lines of it.
        blank: with blank lines between the blocks.
        middle: with the processes and the latencies.
        causes: with those of the misses.
    """

    log: int
    blank: bool = True
    middle: bool = True
    causes: bool = True


def layout(environments: int, lines: int, most_log: int) -> Layout:
    """The richest that fits, of a fleet on a terminal with so many lines; the poorest, if none does."""
    poorest = BORDER + PROGRESS + HEAD + environments + LEARNING
    full = poorest + MIDDLE + CAUSES
    room = lines - (full + 4)  # a blank line above each of five blocks but the first
    if room >= 1:
        return Layout(min(room, most_log))
    if full + 3 <= lines:
        return Layout(0)
    return Layout(0, blank=False, middle=full <= lines, causes=poorest + CAUSES <= lines)


def body(
    now: Now,
    config: RunConfig,
    events: Iterable[tuple[str, Event]],
    *,
    note: str,
    width: int,
    shown: Layout,
) -> RenderableType:
    """The whole screen within its frame.

    Args:
        now: what there is to show.
        config: of the run.
        events: what the processes said.
        note: what the launcher itself is doing.
        width: the screen's, in columns.
        shown: what fits.
    """
    roomy = width >= WIDTH
    blocks: list[list[RenderableType]] = [[panes.progress(now, config, note)]]
    if shown.middle:
        quantiles = QUANTILES if roomy else QUANTILES[:2]
        times = drawing.latencies(panes.latencies(now), quantiles)
        blocks.append([panes.beside(panes.processes(now, 2 if roomy else 1), times, width)])
    blocks.append([envs(now, cast.env_names(config.env), roomy=roomy)])
    blocks.append([panes.learning(now)])
    if shown.causes:
        blocks[-1].append(drawing.pairs([("missed", panes.causes(now))]))
    if shown.log:
        blocks.append([panes.log(events, shown.log)])
    lines: list[RenderableType] = []
    for block in blocks:
        lines += [Text(), *block] if lines and shown.blank else block
    return Group(*lines)


def envs(now: Now, names: Sequence[str], *, roomy: bool) -> Table:
    """The environments' table: all together, then each; `roomy`: with the returns' curves."""
    table = Table.grid(padding=(0, 2 if roomy else 1))
    for style in (LABEL, ""):
        table.add_column(style=style, no_wrap=True)
    for _ in range(5):
        table.add_column(justify="right", no_wrap=True)
    for style in (ACCENT, "yellow"):
        table.add_column(style=style, no_wrap=True)
    heads = ("", "", "ticks/s", "missed", "loop p99 µs", "policy", "return", "", "")
    table.add_row(*(Text(head, style=LABEL) for head in heads))
    table.add_row("all", "", *_measures(now, None, now.rates[ENV_SERVER]))
    for i, (name, rate) in enumerate(zip(names, now.env_rates, strict=True)):
        pair = {f"{role}.{i}": now.states[f"{role}.{i}"] for role in (ENV_SERVER, AGENT)}
        restarts = sum(now.restarts.get(process, 0) for process in pair)
        table.add_row(
            name,
            _state(pair),
            *_measures(now, i, rate),
            drawing.sparkline(now.envs[i].returns, CURVE) if roomy else "",
            f"↻ {restarts}" if restarts else "",
        )
    return table


def _measures(now: Now, index: int | None, rate: float | None) -> list[Text | str]:
    """One environment's numbers; None: those of all, with the policies that were published and the mean of
    the newest returns.
    """
    if index is None:
        env, policy, last = now.env, float(now.learner.counters["published"]), now.last_return
    else:
        env, policy = now.envs[index], now.agents[index].gauges.get("policy_version", 0.0)
        last = env.returns[-1] if env.returns else None
    ticks, missed = env.counters["ticks"], env.counters["missed"]
    return [
        drawing.number(rate, 1),
        drawing.misses(missed, missed / ticks if ticks else None),
        drawing.microseconds(env.quantiles("loop", 1e-3)["p99"]),
        drawing.number(policy),
        drawing.number(last, 1),
    ]


def _state(pair: Mapping[str, str]) -> Text:
    """How an environment's two processes are: `● alive` if both are, else the worse of them."""
    state, names = panes.worst(pair)
    who = "" if len(names) == len(pair) else f"{SHORT[role_of(names[0])]} "
    return Text(f"● {who}{state}", style=STATE_STYLE[state])


def told(states: Mapping[str, str]) -> list[str]:
    """All states, in words: `learner alive`; of several processes `env_server 3 alive 1 starting`."""
    by_role: dict[str, Counter[str]] = {}
    for name, state in states.items():
        by_role.setdefault(role_of(name), Counter())[state] += 1
    return [
        f"{role} " + " ".join(f"{n} {state}" if counts.total() > 1 else state for state, n in counts.items())
        for role, counts in by_role.items()
    ]
