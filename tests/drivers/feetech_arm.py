"""Arms of emulated Feetech servos in virtual time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from servo_arm import Path, ServoArm
from virtual_port import VirtualPort

from bodyschema.drivers.feetech.config import BusConfig, FeetechConfig, ServoConfig
from bodyschema.drivers.feetech.emulator.arm import Chain, Code, Instruction, instructions_in
from bodyschema.drivers.feetech.emulator.servo import Servo
from bodyschema.drivers.feetech.joints import FeetechJoints
from bodyschema.drivers.feetech.models import BY_NAME


class HeardPort(VirtualPort):
    """A port that records what is sent."""

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.heard: list[Instruction] = []

    def write(self, data: bytes) -> None:
        self.heard += instructions_in(bytearray(data))[0]
        super().write(data)

    def writes(self) -> list[tuple[int, bytes]]:
        """Return address and data of all writes to servos."""
        told = [i for i in self.heard if i.code in (Code.WRITE, Code.REG_WRITE, Code.SYNC_WRITE, Code.RESET)]
        return [(i.params[0], i.params[1:]) for i in told]


class FeetechArm(ServoArm):
    """A driver of Feetech servos on an emulator."""

    def __init__(
        self,
        models: Sequence[str] = ("STS3215",) * 3,
        paths: Sequence[Path] | None = None,
        *,
        latency_s: float = 0.0,
        held_s: float = 0.0,
        delay_s: float = 0.0,
        seed: int = 0,
        sync: Literal["auto", "never"] = "auto",
        limits: Sequence[tuple[float, float]] | None = None,
        last_pose: Sequence[float] | None = None,
        multi_turn: bool = False,
        **settings,
    ) -> None:
        def servo(model: str, id: int, path: Path) -> Servo:
            return Servo(BY_NAME[model], id, path, return_delay_s=delay_s, multi_turn=multi_turn)

        wire = {"latency_s": latency_s, "held_s": held_s, "seed": seed}
        super().__init__(models, paths, servo=servo, chain=Chain, port=HeardPort, **wire)
        config = FeetechConfig({"arm": BusConfig("emulator", sync_read=sync)}, self.entries(ServoConfig), **settings)
        self.driven(FeetechJoints, config, limits=limits, last_pose=last_pose)
