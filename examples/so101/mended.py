"""Write mended.toml: the worn arm with the new follower.json in its servos, as docs/lerobot.md has it."""

import json
import math
import re
from pathlib import Path

before, after = (json.loads(Path(name).read_text()) for name in ("follower.json.before", "follower.json"))


def left(effect: re.Match[str]) -> str:
    """Return a joint offset without what the new homing offset adds to the readings."""
    joint, offset_rad = effect.groups()
    ticks = (before[joint]["homing_offset"] - after[joint]["homing_offset"] + 2048) % 4096 - 2048
    return f'where = "{joint}"\noffset_rad = {float(offset_rad) - ticks * math.tau / 4096:.5f}'


worn = Path("worn.toml").read_text()
Path("mended.toml").write_text(re.sub(r'where = "(\w+)"\noffset_rad = (\S+)', left, worn))
