"""What an operator may ask of the learner, and how it is carried out."""

from __future__ import annotations

from collections.abc import Iterable

from learner.conductor import Conductor, Happening
from learner.schedule.scheduler import Scheduler
from rtcore.clock import Clock
from rtcore.config import ConfigError
from rtcore.ledger import Ledger
from rtcore.messages import Command, CommandReply

DONE = {  # what is said of an order that will be carried out
    "hold": "the policy will be held",
    "resume": "the schedule will go on",
    "schedule": "the schedule will change when the present window has ended",
}


class Orders:
    """Orders come on the bus's thread; the learner's carries them out between two steps."""

    def __init__(self, conductor: Conductor, scheduler: Scheduler, clock: Clock, ledger: Ledger) -> None:
        self._conductor = conductor
        self._scheduler = scheduler
        self._clock = clock
        self._ledger = ledger
        self._waiting: list[Command] = []

    def take(self, command: Command) -> CommandReply:
        """Accept an order, or say why not. From any thread."""
        if command.verb not in DONE:
            return self._refuse(command, f"the learner knows no '{command.verb}'")
        if command.verb == "schedule":
            if command.schedule is None:
                return self._refuse(command, "schedule = None: must be given")
            try:
                self._scheduler.check(command.schedule)
            except ConfigError as error:
                return self._refuse(command, str(error))
        self._waiting.append(command)
        return CommandReply(id=command.id, ok=True, text=DONE[command.verb])

    def carry_out(self, t0_ns: int) -> Iterable[Happening]:
        """All that waits, in order; and what happens at once because of it."""
        while self._waiting:
            yield from self._obey(self._waiting.pop(0), t0_ns)

    def _obey(self, order: Command, t0_ns: int) -> list[Happening]:
        now_ns, position = self._clock.now_ns(), self._conductor.position
        text: str = order.verb
        if order.schedule is not None and position is not None:
            text = self._scheduler.change(order.schedule, position)
        self._ledger.event(now_ns, "INFO", f"operator: {text}")
        if order.verb == "schedule":
            return self._conductor.rescheduled(now_ns - t0_ns)
        if order.verb == "resume":
            return self._conductor.resume(now_ns - t0_ns)
        if order.verb == "hold":
            self._ledger.count("operator_holds")
            return self._conductor.pause(now_ns - t0_ns)
        return []

    @staticmethod
    def _refuse(command: Command, why: str) -> CommandReply:
        return CommandReply(id=command.id, ok=False, text=why)
