"""`bodyschema demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from rich.console import Console

OUT = Path("bodyschema-demo")
WHAT = {
    "dynamixel": "Dynamixel servos",
    "feetech": "Feetech servos",
    "serial": "encoders of a board",
    "ros2": "a robot's",
}


def demo(
    *,
    out: Annotated[Path, Parameter(help="Folder for the recording, the curve and the plot.")] = OUT,
    pairs: Annotated[int, Parameter(help="Samples to learn before the tool change.", validator=Number(gte=1))] = 600,
    pairs_after: Annotated[int, Parameter(help="Samples to learn after it.", validator=Number(gte=1))] = 300,
    seed: Annotated[int, Parameter(help="Another robot, another path, other noise.", validator=Number(gte=0))] = 0,
    bus: Annotated[
        Literal["dynamixel", "feetech", "serial", "ros2"] | None,
        Parameter(help="The joints are emulated and read by this driver.", show_default=False),
    ] = None,
    marker: Annotated[
        Literal["ball", "tag", "cluster"] | None,
        Parameter(
            help="In the hand: a red ball, one AprilTag (which --camera mono has by default), or a cube of six, which "
            "the cameras see from all sides.",
            show_default=False,
        ),
    ] = None,
    camera: Annotated[
        Literal["stereo", "mono"], Parameter(help="Two cameras side by side, or one alone, as a webcam is.")
    ] = "stereo",
) -> None:
    """Watch the whole thing learn, in simulation, in about a minute.

    A humanoid's arm is guided by a virtual hand, and its head cameras see a red ball on the tool. The sampler and the
    learner run as the two real processes; half-way the tool becomes 250 mm longer.

    With --marker cluster the ball is replaced by a cube of AprilTags, whose orientation is learnt too. With --marker
    tag it is a single tag, visible only while it faces the cameras: the hand turns it to them.

    With --camera mono one eye is closed: the marker's distance follows from the size of the tag.

    With --bus the joints are read as on a real arm, by the driver: from Dynamixel or Feetech servos or a board of
    encoders (serial) on a serial port, or from a ROS 2 robot behind a zenoh router. All of these are emulated at the
    byte level, and follow the simulated arm.

    Needs: the extra `sim` (`pip install 'bodyschema[sim]'`), and no hardware.

    Next: `bodyschema replay` on the recording of the first tool; `bodyschema init` for a robot of your own.
    """
    import numpy as np

    from bodyschema.cli.demo.play import play, plot_curve, write_curve
    from bodyschema.cli.demo.scene import prepare
    from bodyschema.cli.demo.view import show_outcome, shown_on
    from bodyschema.interfaces.extras import require_extra
    from bodyschema.recordings import files as recordings

    require_extra("sim", "the simulation")
    console = Console(highlight=False)
    marker = marker or ("tag" if camera == "mono" else "ball")
    scene = prepare(out, seed, bus=bus, marker=marker, camera=camera)
    if bus is not None:
        console.print(f"The joints are {WHAT[bus]}, emulated; their log is {scene.log_file}.", soft_wrap=True)
    with shown_on(console) as show:
        outcome = play(scene, first=pairs, second=pairs_after, seed=seed, show=show)
    write_curve(outcome.rows, scene.curve_file)
    plot_curve(outcome.rows, outcome.first_tool.pairs, scene.plot_file)
    recording = recordings.from_store(scene.store_file)
    recordings.write(recording, scene.recording_file)
    recordings.write(recording.rows(np.arange(outcome.changed_at)), scene.first_tool_file)
    show_outcome(console, outcome, scene)
