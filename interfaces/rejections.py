"""Descriptions and remedies of the reasons why frames are rejected."""

from __future__ import annotations

from collections.abc import Mapping

from .records import Reason

WORDS: Mapping[Reason, str] = {
    Reason.NO_MARKER: "no marker",
    Reason.AT_BORDER: "at the border",
    Reason.OCCLUDED: "partly covered",
    Reason.NOT_ROUND: "not round",
    Reason.NOT_STRAIGHT: "edges not straight",
    Reason.MIRRORED: "mirrored",
    Reason.OTHER_FAMILY: "a tag of another dictionary",
    Reason.LOW_CONTRAST: "too little contrast",
    Reason.BLURRED: "too blurred",
    Reason.SATURATED: "over-exposed",
    Reason.REFLECTION: "a reflection",
    Reason.REPROJECTION: "not the marker's shape",
    Reason.DISAGREEING: "sources disagree",
    Reason.IMPLAUSIBLE_SPEED: "too far from the last place",
    Reason.EPIPOLAR: "rows differ",
    Reason.SIZE_MISMATCH: "sizes differ",
    Reason.AMBIGUOUS: "more than one fits",
    Reason.NO_JOINTS: "no encoder readings at its time",
    Reason.STALE: "encoder readings too far apart",
    Reason.MOVING: "joints too fast for the time stamps",
    Reason.LATE_JOINTS: "joints too fast for the times of their readings",
    Reason.TOO_NEAR: "hardly any motion since the last sample",
    Reason.PAUSED: "paused",
    Reason.NOT_FINITE: "a position that is no number",
    Reason.NOT_STORED: "the disk took no sample",
    Reason.NOT_BORNE: "zero-force is off",
}
REMEDIES: Mapping[Reason, str] = {
    Reason.NO_MARKER: "Is it in sight of all eyes, large enough in their images, and are [vision] marker, colour, "
    "number and light right? A chessboard has to be seen whole.",
    Reason.AT_BORDER: "Bring it nearer to the middle of both images.",
    Reason.OCCLUDED: "Is a hand, a cable or the tool before it? A chessboard has to be seen whole.",
    Reason.NOT_ROUND: "Is a finger or a cable before its edge, or does it move too fast for the exposure? Light its "
    "dark side, and take a plain, matt ball.",
    Reason.NOT_STRAIGHT: "Glue the paper flat, and take away what covers an edge.",
    Reason.MIRRORED: "Print the tag without mirroring, and switch off the camera's mirroring.",
    Reason.OTHER_FAMILY: "Set [vision.tag] dictionary to what is printed: the log names it. Or print a tag of that "
    "dictionary: `bodyschema marker print`.",
    Reason.LOW_CONTRAST: "More light, and a background that is neither black nor of its colour. A tag needs its white "
    "margin.",
    Reason.BLURRED: "Focus the lens, expose for a shorter time, or take a larger tag.",
    Reason.SATURATED: "Shorten exposure_s, less light.",
    Reason.REFLECTION: "Turn the lamp or what mirrors it away, or mask it.",
    Reason.REPROJECTION: "Is the paper flat, the light not too bright, and is each tag where robot.toml has it?",
    Reason.DISAGREEING: "The sampler's health says by how much, and what would make them agree: `bodyschema status`.",
    Reason.IMPLAUSIBLE_SPEED: "Is another thing of its colour in sight? Else guide the arm more slowly, or raise "
    "[daemon] max_marker_speed_m_s.",
    Reason.EPIPOLAR: "Are the cameras exchanged, one upside down, or moved? `bodyschema calibrate cameras --check` "
    "shows it.",
    Reason.SIZE_MISMATCH: "Is its size in [vision] as measured, and was --square-mm that of the printed board? Else it "
    "is the calibration of other cameras, or they were moved: `bodyschema calibrate cameras --check`.",
    Reason.AMBIGUOUS: "Take other things of its colour, or the second tag of its number, out of sight. Tilt a single "
    "tag, or come nearer.",
    Reason.NO_JOINTS: "Do the encoders answer, and is [vision.cameras] latency_s right? `bodyschema calibrate latency` "
    "measures it.",
    Reason.STALE: "Read the encoders more often, or raise [daemon] max_reading_gap_s.",
    Reason.MOVING: "Guide the arm more slowly, or measure the cameras' latency: `bodyschema calibrate latency`.",
    Reason.LATE_JOINTS: "Guide the arm more slowly, end other programs that keep the machine busy, or see what "
    "`bodyschema doctor` says of latency timer and return delay.",
    Reason.TOO_NEAR: "Move the arm.",
    Reason.PAUSED: "Resume with `bodyschema command resume`.",
    Reason.NOT_FINITE: "That is a fault of the tracker in [vision.plugin], or of the program in [marker_source].",
    Reason.NOT_STORED: "Make room on the disk of the store, and see that it can be written.",
    Reason.NOT_BORNE: "Switch it on: `bodyschema command zero_force_on`.",
}


def rejection_text(reason: str) -> str:
    """Return the description of a reason in a status message, also for a reason of a newer version."""
    return WORDS[Reason(reason)] if reason in set(Reason) else reason.replace("_", " ")
