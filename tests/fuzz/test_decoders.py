"""All that is read back, from the wire or the disk: whatever the bytes, an answer or an error of its own."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from learner import checkpoint, diary, marks
from learner.checkpoint import CheckpointError, State
from learner.place import Place as LearnerPlace
from learner.place import Progress
from learner.schedule.timetable import Timetable
from recorder.place import EnvPlace, Kept, Place, PlaceFile
from rtcore import epoch, tally
from rtcore.codec import Rejections
from rtcore.commands import CommandClient, CommandServer
from rtcore.config import ConfigError, RunConfig, ScheduleConfig
from rtcore.config_io import dump_toml, load_toml
from rtcore.epoch import Epoch
from rtcore.histogram import Histogram
from rtcore.messages import Command, CommandReply
from rtcore.run_dir import RunDir
from rtcore.tally import Tally
from rtcore.weights import WeightsError, pack, unpack
from tests.rtcore import bus_samples


@dataclass(frozen=True)
class Decoder:
    """What reads bytes, what is right, and the errors that are its own."""

    read: Callable[[bytes], object]
    right: bytes
    errors: tuple[type[Exception], ...] = ()


def file(path: Path, read: Callable[[Path], object]) -> Callable[[bytes], object]:
    def written(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return written


def histogram() -> Decoder:
    full = Histogram()
    for value in (0, 5, 200, 10**6, 10**12, 1 << 62):
        full.record(value)

    def read(data: bytes) -> None:
        found = Histogram.from_bytes(data)
        for q in (0.0, 0.5, 0.999, 1.0):
            found.quantile(q)
        found.merge(full)
        Histogram.from_bytes(found.to_bytes())

    return Decoder(read, full.to_bytes(), (ValueError,))


def checkpoints(path: Path) -> Decoder:
    state = State({"actor": np.ones(3, np.float32)}, {"steps": 3, "list": [1.0, 2]})
    checkpoint.save(path, state)
    manifest = path / checkpoint.MANIFEST
    return Decoder(file(manifest, lambda _: checkpoint.load(path)), manifest.read_bytes(), (CheckpointError,))


def policy_file(run_dir: RunDir) -> Decoder:
    run_dir.policy_path.parent.mkdir(exist_ok=True)
    right = msgspec.msgpack.encode(bus_samples.policy(3))
    return Decoder(file(run_dir.policy_path, lambda _: run_dir.read_policy()), right)


def final_stats(run_dir: RunDir) -> Decoder:
    stats = bus_samples.stats("learner")
    run_dir.write_final_stats(stats)
    path = run_dir.stats_path(stats.process, stats.incarnation)
    return Decoder(file(path, lambda _: run_dir.read_final_stats()), msgspec.msgpack.encode(stats))


def tallies(path: Path) -> Decoder:
    kept = Tally.create(path)
    kept.set("ticks", 7)
    kept.set_together({"missed": 1, "missed.agent_late": 1})
    kept.close()
    return Decoder(file(path, tally.read), path.read_bytes())


def diaries(path: Path) -> Decoder:
    entry = diary.Acted(incarnation=1, next_seq=9, unit=3, ticks={0: 5, -1: 1})
    encoded = msgspec.msgpack.encode(entry)
    right = b"".join(len(encoded).to_bytes(4, "little") + encoded for _ in range(3))
    return Decoder(file(path, diary.read), right)


def timetables() -> Decoder:
    def read(data: bytes) -> None:
        table = Timetable(ScheduleConfig(), lambda _config, _start: 2)
        table.load(data)
        for t in (0, 1, 50):
            table.window_at(t)

    changed = Timetable(ScheduleConfig(kind="auto"), lambda _config, _start: 2)
    changed.change(ScheduleConfig(kind="explicit", t_m=(0, 13), g_m=(10, 4)), changed.window_at(3), 3)
    return Decoder(read, changed.dump(), (ValueError,))


def replay_marks(path: Path) -> Decoder:
    shape = {"capacity": 10}
    opened = marks.Marks.open(path, shape, room=64)
    opened.write(marks.Record(3, 0, b"note"))

    def read(found: Path) -> None:
        marks.read(found)
        marks.Marks.open(found, shape, room=64)

    return Decoder(file(path, read), path.read_bytes(), (marks.MarksError,))


def recorder_place(path: Path) -> Decoder:
    place = PlaceFile(path)
    place.keep(Kept(1, 2, Place({"env0": EnvPlace((3, 4))}, {"learner": "core 1"})))
    place.close()
    return Decoder(file(path, lambda found: PlaceFile(found).read()), path.read_bytes())


def commands() -> Decoder:
    rejections = Rejections(lambda: 0)
    server = CommandServer(lambda command: CommandReply(id=command.id, ok=True, text=""), rejections)
    command = Command(id="1", verb="schedule", schedule=ScheduleConfig())
    client = CommandClient(command, rejections)

    def read(data: bytes) -> None:
        before = rejections.counts().get("control", 0)
        answered = [server.answer(data) is not None, client.accept(data) is not None]
        assert rejections.counts().get("control", 0) - before == 2 - sum(answered)

    return Decoder(read, client.payload)


def decoders(path: Path) -> dict[str, Decoder]:
    run_dir = RunDir.create(path / "run", RunConfig())
    epochs = Epoch(t0_ns=1, wall_t0_ns=2, boot_id="b")
    return {
        "histogram": histogram(),
        "weights": Decoder(unpack, pack({"mean.bias": np.ones(4, np.float32)}), (WeightsError,)),
        "config": Decoder(
            file(path / "run.toml", load_toml), dump_toml(RunConfig()).encode(), (ConfigError,)
        ),
        "checkpoint": checkpoints(path / "checkpoint"),
        "policy": policy_file(run_dir),
        "stats": final_stats(run_dir),
        "diary": diaries(path / "diary"),
        "epoch": Decoder(file(path / "epoch", epoch.read), msgspec.json.encode(epochs), (ConfigError,)),
        "tally": tallies(path / "tally"),
        "timetable": timetables(),
        "marks": replay_marks(path / "marks"),
        "learner_place": Decoder(
            LearnerPlace.decode,
            LearnerPlace(envs={"env0": Progress(previous=bus_samples.step(3))}).encode(),
            (ValueError,),
        ),
        "recorder_place": recorder_place(path / "place"),
        "command": commands(),
    }


NAMES = (
    "histogram", "weights", "config", "checkpoint", "policy", "stats", "diary", "epoch", "tally", "timetable",
    "marks", "learner_place", "recorder_place", "command",
)  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, right: bytes) -> bytes:
    """Noise, or what is right with a piece cut out, put in or changed."""
    if draw(st.integers(0, 4)) == 0:
        return draw(st.binary(max_size=200) | st.text(max_size=60).map(str.encode) | json_text)
    begin = draw(st.integers(0, len(right)))
    end = min(len(right), begin + draw(st.sampled_from((0, 1, 1, 2, 8, len(right)))))
    piece = draw(st.binary(max_size=9) | st.sampled_from(PIECES))
    return right[:begin] + piece + right[end:]


PIECES = (
    b"\xc0",
    b"\xff" * 8,
    b"\x7f" * 9,
    b"[" * 5000,
    b"\x91" * 5000,
    b"null",
    b"-1",
    b"1e999",
    b"NaN",
    b"{}",
)
json_text = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
).map(lambda value: json.dumps(value).encode())


@pytest.mark.parametrize("name", NAMES)
def test_whatever_the_bytes_it_answers_or_says_what_is_wrong(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, messages: int
) -> None:
    decoder = decoders(tmp_path)[name]
    decoder.read(decoder.right)

    @settings(max_examples=messages // 1000, suppress_health_check=[HealthCheck.too_slow])
    @given(damaged(decoder.right))
    def read(data: bytes) -> None:
        with suppress(*decoder.errors):
            decoder.read(data)

    with caplog.at_level(logging.CRITICAL):
        read()


def test_every_decoder_is_tried(tmp_path: Path) -> None:
    assert tuple(decoders(tmp_path)) == NAMES
