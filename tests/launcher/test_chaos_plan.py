"""Which faults are planned: by hand, and as laws over many seeds."""

from __future__ import annotations

from collections import Counter

import pytest

from launcher.chaos.plan import BEGIN_S, END_S, FILLED, KINDS, LINK, Fault, parse_kinds, plan
from rtcore.channels import ENV_SERVER, LEARNER, PROCESSES
from rtcore.config import ConfigError


def test_the_same_seed_gives_the_same_faults_and_another_gives_others() -> None:
    assert plan(3, 60, 600.0, ("kill", "stop")) == plan(3, 60, 600.0, ("kill", "stop"))
    assert plan(3, 60, 600.0, ("kill", "stop")) != plan(4, 60, 600.0, ("kill", "stop"))


@pytest.mark.parametrize("seed", range(20))
def test_sixty_faults_in_ten_minutes_befall_everybody_alike(seed: int) -> None:
    faults = plan(seed, 60, 600.0, ("kill", "stop"))
    assert len(faults) == 60
    assert [fault.at_s for fault in faults] == sorted(fault.at_s for fault in faults)
    assert all(BEGIN_S <= fault.at_s <= 600.0 - END_S for fault in faults)
    # dealt: 60 = 15 hands of the four processes, 30 of the two kinds
    assert Counter(fault.process for fault in faults) == dict.fromkeys(PROCESSES, 15)
    assert Counter(fault.kind for fault in faults) == {"kill": 30, "stop": 30}
    assert all(fault.for_s == 0.0 for fault in faults if fault.kind == "kill")
    assert all(0.1 <= fault.for_s <= 3.0 for fault in faults if fault.kind == "stop")


def test_a_short_run_keeps_a_quarter_free_at_either_end() -> None:
    faults = plan(0, 100, 8.0, ("kill",))
    assert min(fault.at_s for fault in faults) >= 2.0
    assert max(fault.at_s for fault in faults) <= 6.0


@pytest.mark.parametrize("seed", range(20))
def test_only_who_writes_gets_a_full_disk(seed: int) -> None:
    faults = plan(seed, 12, 60.0, ("fill",))
    assert Counter(fault.process for fault in faults).keys() == set(FILLED)
    assert all(1.0 <= fault.for_s <= 5.0 for fault in faults)


def test_a_partition_is_the_links() -> None:
    assert {fault.process for fault in plan(0, 12, 60.0, ("partition",))} == {LINK}


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        ((0, 0, 60.0, ("kill",)), "kills"),
        ((0, 5, 7.9, ("kill",)), "duration_s"),
        ((0, 5, float("nan"), ("kill",)), "duration_s"),
        ((0, 5, 60.0, ()), "kinds"),
        ((0, 5, 60.0, ("burn",)), "kinds"),
    ],
)
def test_what_cannot_be_planned_is_refused(
    arguments: tuple[int, int, float, tuple[str, ...]], name: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        plan(*arguments)  # type: ignore[arg-type]
    assert caught.value.name == name


def test_kinds_as_one_word() -> None:
    assert parse_kinds("stop, kill,stop") == ("kill", "stop")
    assert parse_kinds(",".join(KINDS)) == KINDS
    for text in ("", "kill,burn", "kill stop"):
        with pytest.raises(ConfigError, match="kinds"):
            parse_kinds(text)


def test_what_a_fault_does() -> None:
    assert Fault(1.0, ENV_SERVER, "kill").deeds == ((0.0, "kill"),)
    assert Fault(1.0, ENV_SERVER, "stop", 2.5).deeds == ((0.0, "stop"), (2.5, "continue"))
    assert Fault(1.0, LEARNER, "fill", 2.0).deeds == ((0.0, "fill"), (2.0, "empty"))
    assert Fault(1.0, LINK, "partition", 3.0).deeds == ((0.0, "cut"), (3.0, "mend"))
    # 0.1 s in turns of 20 ms: two whole ones of 40 ms, and the half one that is left makes no third
    slow = Fault(1.0, LEARNER, "slow", 0.1).deeds
    assert [deed for _, deed in slow] == ["stop", "continue"] * 2
    assert [at_s for at_s, _ in slow] == pytest.approx([0.0, 0.02, 0.04, 0.06])
