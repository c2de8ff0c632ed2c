"""Decode and check the position that a Feetech servo reports."""

from __future__ import annotations

from bodyschema.drivers.servos.bus import Answer
from bodyschema.drivers.servos.channel import Channel as ServoChannel
from bodyschema.drivers.servos.channel import Sample

from .models import HARDWARE_ERRORS

LARGEST_POSITION = 30_719  # 7.5 turns
KNOWN_ERRORS = sum(HARDWARE_ERRORS)


class Channel(ServoChannel):
    """The answers of one servo since the bus was opened."""

    def _sample(self, answer: Answer) -> Sample | None:
        data, model = answer.status.data, self.servo.model
        layout = model.layout

        def told(name: str) -> int:
            return layout.value(name, data, layout.block.address)

        position, moving = told("position"), told("moving")
        if moving > 1 or told("status") & ~KNOWN_ERRORS or not self._is_possible(position):
            return None
        if not self._is_steady(told("voltage"), told("temperature")):
            return None
        amperes = None if model.current_unit is None else told("current") * model.current_unit
        return Sample(
            question=self.question(answer),
            expected=answer.earliest,
            earliest=answer.earliest,
            latest=answer.latest,
            ticks=position,
            velocity=told("velocity") * model.velocity_unit,
            current=amperes,
            moving=bool(moving),
            alert=answer.status.error != 0,
        )

    def _is_possible(self, position: int) -> bool:
        if self.servo.model.ticks_per_turn is None:
            return 0 <= position < 2 * self.servo.model.zero_ticks
        return abs(position) <= LARGEST_POSITION
