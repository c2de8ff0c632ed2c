"""`bodyschema board`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from bodyschema.cli.commands.board_options import AS_DRAWN, DrawnBoard


def board(
    *,
    drawn: DrawnBoard = AS_DRAWN,
    paper: Annotated[str, Parameter(help="A4, A3, A2, A1, A0, letter, legal or tabloid.")] = "A4",
    out: Annotated[Path, Parameter(help="The file to write, .pdf or .svg.")] = Path("board.pdf"),
) -> None:
    """Write the calibration board as a page to print, in true size.

    Print it at 100 % ("actual size"), measure the two rulers on the page, and glue the sheet onto something flat and
    stiff: glass, aluminium, thick board. A bent sheet gives a wrong calibration that looks like a good one.

    Needs: a printer.

    Next: `bodyschema calibrate cameras` with the same options; add --ruler-mm if a ruler does not have its stated
    length.
    """
    from rich.console import Console

    from bodyschema.cli.cameras.calibration import write_board

    made = drawn.board()
    across, upright = write_board(made, paper, out)
    Console(highlight=False).print(
        f"{out} written: {made.name}. Print it at 100 %, then measure: the line below the board is {across:g} mm, the "
        f"one beside it {upright:g} mm.",
        markup=False,
        soft_wrap=True,
    )
