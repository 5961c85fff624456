from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from rtcore.messages import Step, StepBatch
from rtcore.stream import StepStream, Transitions
from tests.rtcore.steps import make_step


def batch(*seqs: int, incarnation: int = 1, last: bool = False) -> StepBatch:
    return StepBatch(steps=[make_step(seq, incarnation=incarnation) for seq in seqs], last=last)


def seqs(steps: list[Step]) -> list[int]:
    return [step.seq for step in steps]


def names(steps: list[Step]) -> list[tuple[int, int]]:
    return [(step.incarnation, step.seq) for step in steps]


def counts(stream: StepStream) -> dict[str, int]:
    fields = ("received", "delivered", "duplicate", "late", "gaps", "waiting")
    return {name: value for name in fields if (value := getattr(stream, name))}


def test_steps_in_order_go_straight_through() -> None:
    assert StepStream().position is None
    stream = StepStream()
    assert seqs(stream.feed(batch(0, 1))) == [0, 1]
    assert seqs(stream.feed(batch(2))) == [2]
    assert stream.position == (1, 3)
    assert counts(stream) == {"received": 3, "delivered": 3}


def test_the_history_may_come_after_the_first_live_batch() -> None:
    stream = StepStream()
    assert stream.feed(batch(4, 5)) == []
    assert seqs(stream.feed(batch(0, 1))) == [0, 1]
    assert counts(stream) == {"received": 4, "delivered": 2, "waiting": 2}
    assert seqs(stream.feed(batch(2, 3))) == [2, 3, 4, 5]
    assert counts(stream) == {"received": 6, "delivered": 6}


def test_a_replayed_history_is_counted_and_left_out() -> None:
    stream = StepStream()
    stream.feed(batch(0, 1, 2, 3))
    stream.feed(batch(6, 7))
    assert stream.feed(batch(0, 1)) == []
    assert seqs(stream.feed(batch(2, 3, 4, 5, 6, 7))) == [4, 5, 6, 7]
    assert stream.feed(batch(7)) == []
    assert counts(stream) == {"received": 15, "delivered": 8, "duplicate": 7}


def test_giving_up_counts_the_oldest_gap() -> None:
    stream = StepStream()
    assert stream.give_up() == []
    stream.feed(batch(2, 3, 6, 9))
    assert seqs(stream.give_up()) == [2, 3]
    assert (stream.gaps, stream.position) == (2, (1, 4))
    assert seqs(stream.feed(batch(4, 5))) == [4, 5, 6]  # this gap could still be filled
    assert seqs(stream.give_up()) == [9]
    assert counts(stream) == {"received": 6, "delivered": 6, "gaps": 4}


def test_what_comes_after_it_was_given_up_is_late() -> None:
    stream = StepStream()
    stream.feed(batch(0, 3))
    assert seqs(stream.give_up()) == [3]
    assert stream.feed(batch(0, 1, 2, 3)) == []
    assert counts(stream) == {"received": 6, "delivered": 2, "gaps": 2, "late": 2, "duplicate": 2}


def test_late_and_duplicate_are_told_apart_between_gaps() -> None:
    stream = StepStream()
    for numbers in ((0, 1), (4, 5), (9,)):  # 2, 3 and 6, 7, 8 are given up
        stream.feed(batch(*numbers))
        stream.give_up()
    assert stream.gaps == 5
    for seq, late, duplicate in ((1, 0, 1), (2, 1, 1), (3, 2, 1), (4, 2, 2), (5, 2, 3), (8, 3, 3), (9, 3, 4)):
        stream.feed(batch(seq))
        assert (stream.late, stream.duplicate) == (late, duplicate), seq


def test_flush_gives_up_every_gap() -> None:
    stream = StepStream()
    stream.feed(batch(1, 4, 5, 8))
    assert seqs(stream.flush()) == [1, 4, 5, 8]
    assert stream.flush() == []
    assert counts(stream) == {"received": 4, "delivered": 4, "gaps": 5}  # 0, 2, 3, 6, 7


def test_a_bounded_number_waits() -> None:
    stream = StepStream(max_waiting=3)
    assert stream.feed(batch(1, 2, 4)) == []
    assert seqs(stream.feed(batch(6))) == [1, 2]  # 0 is given up; 4 and 6 go on waiting
    assert counts(stream) == {"received": 4, "delivered": 2, "gaps": 1, "waiting": 2}
    assert seqs(stream.feed(batch(8, 10, 12))) == [4, 6]
    assert counts(stream) == {"received": 7, "delivered": 4, "gaps": 3, "waiting": 3}


def test_the_default_bound_is_4000() -> None:
    stream = StepStream()
    assert stream.feed(batch(*range(1, 4001))) == []
    assert len(stream.feed(batch(4001))) == 4001
    assert stream.gaps == 1


def test_a_new_incarnation_closes_the_old_one() -> None:
    stream = StepStream()
    stream.feed(batch(0, 1, 3, 6))
    assert names(stream.feed(batch(0, 1, incarnation=5))) == [(1, 3), (1, 6), (5, 0), (5, 1)]
    assert counts(stream) == {"received": 6, "delivered": 6, "gaps": 3}
    assert stream.feed(batch(2, 3, 9)) == []  # of the old one
    assert counts(stream) == {"received": 9, "delivered": 6, "gaps": 3, "late": 3}
    assert stream.position == (5, 2)


def test_given_up_numbers_belong_to_their_incarnation() -> None:
    stream = StepStream()
    stream.feed(batch(2))
    stream.give_up()
    assert names(stream.feed(batch(0, 1, incarnation=2))) == [(2, 0), (2, 1)]
    stream.feed(batch(0, incarnation=2))
    assert (stream.late, stream.duplicate) == (0, 1)


def test_a_new_incarnation_may_itself_begin_late() -> None:
    stream = StepStream()
    stream.feed(batch(0))
    assert stream.feed(batch(2, incarnation=2)) == []
    assert names(stream.feed(batch(0, 1, incarnation=2))) == [(2, 0), (2, 1), (2, 2)]


def test_a_restarted_reader_goes_on_where_it_was() -> None:
    stream = StepStream(position=(7, 50))
    assert stream.position == (7, 50)
    assert seqs(stream.feed(batch(48, 49, 50, incarnation=7))) == [50]
    assert counts(stream) == {"received": 3, "delivered": 1, "duplicate": 2}
    other = StepStream(position=(7, 50))
    assert names(other.feed(batch(0, incarnation=8))) == [(8, 0)]


def test_the_end_is_known_once_nothing_is_missing() -> None:
    stream = StepStream()
    ended = []
    for fed in (
        batch(0),
        batch(3, last=True),
        batch(1, 2),
        batch(0, incarnation=2),
        batch(3, last=True),  # the old one's end, again
        StepBatch(steps=[], last=True),
    ):
        stream.feed(fed)
        ended.append(stream.ended)
    assert ended == [False, False, True, False, False, True]


def test_an_end_that_steps_follow_was_none() -> None:
    stream = StepStream()
    stream.feed(batch(0, 1))
    ended = []
    for fed in (StepBatch(steps=[], last=True), batch(2), batch(4, last=True), batch(3), batch(5)):
        stream.feed(fed)
        ended.append(stream.ended)
    assert ended == [True, False, False, True, False]  # step 3 comes before the end that 4 said


def tuples(steps: list[Step]) -> list[tuple[object, ...]]:
    """The transitions in a list of steps, comparable."""
    transitions = Transitions(2, 1)
    made = [transition for step in steps if (transition := transitions.feed(step)) is not None]
    assert transitions.transitions == len(made)
    assert len(made) + transitions.resets + transitions.broken + transitions.invalid == len(steps)
    return [
        (t.incarnation, t.seq, t.obs.tobytes(), t.decision.tobytes(), t.reward, t.next_obs.tobytes())
        for t in made
    ]


def cut(steps: list[Step], sizes: list[int]) -> list[StepBatch]:
    """The steps in batches of the given sizes, the rest in one."""
    batches = []
    for size in sizes:
        batches.append(StepBatch(steps=steps[:size]))
        steps = steps[size:]
    return [*batches, StepBatch(steps=steps)]


@given(
    length=st.integers(1, 60),
    sizes=st.lists(st.integers(0, 9), max_size=12),
    data=st.data(),
)
def test_shuffled_and_repeated_batches_give_the_same_transitions_once(
    length: int, sizes: list[int], data: st.DataObject
) -> None:
    steps = [make_step(seq) for seq in range(length)]
    batches = cut(steps, sizes)
    batches += data.draw(st.lists(st.sampled_from(batches), max_size=10))
    stream = StepStream()
    delivered: list[Step] = []
    for shuffled in data.draw(st.permutations(batches)):
        delivered += stream.feed(shuffled)
        assert stream.received == stream.delivered + stream.duplicate + stream.late + stream.waiting
    assert delivered == steps
    assert tuples(delivered) == tuples(steps)
    fed = sum(len(one_batch.steps) for one_batch in batches)
    assert counts(stream) == counts_of(received=fed, delivered=length, duplicate=fed - length)


def counts_of(**fields: int) -> dict[str, int]:
    return {name: value for name, value in fields.items() if value}


@given(
    fed=st.lists(
        st.tuples(
            st.integers(1, 3),  # incarnation
            st.integers(0, 30),  # first seq
            st.integers(0, 6),  # steps
            st.booleans(),  # give up afterwards
        ),
        max_size=30,
    ),
    max_waiting=st.integers(0, 12),
)
def test_whatever_comes_steps_are_handed_out_once_in_order_and_all_counted(
    fed: list[tuple[int, int, int, bool]], max_waiting: int
) -> None:
    stream = StepStream(max_waiting=max_waiting)
    delivered: list[Step] = []
    for incarnation, first, length, give_up in fed:
        delivered += stream.feed(batch(*range(first, first + length), incarnation=incarnation))
        assert stream.waiting <= max_waiting
        if give_up:
            delivered += stream.give_up()
        assert stream.received == stream.delivered + stream.duplicate + stream.late + stream.waiting
    delivered += stream.flush()
    assert stream.waiting == 0 and stream.delivered == len(delivered)
    handed_out = names(delivered)
    assert all(before < after for before, after in pairwise(handed_out))
    newest = dict(handed_out)  # incarnation -> its last seq
    assert stream.gaps == sum(newest.values()) + len(newest) - len(delivered)
    assert len(tuples(delivered)) == sum(
        before.seq + 1 == after.seq and before.incarnation == after.incarnation and after.episode_tick > 0
        for before, after in pairwise(delivered)
    )
