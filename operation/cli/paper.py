"""``paper``: every figure and number of the paper on one page."""

from pathlib import Path
from typing import Annotated

import typer

from operation.cli.options import GivenLine

__all__ = ["paper"]


def paper(
    tracks: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            show_default="built-in tracks",
            help="Folder with ethz.csv and ethzmobil.csv, and f110_map2.csv and "
            "ethz_published_raceline.csv if you have them.",
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            show_default="none",
            help="Folder of the published arrays DYN-PP-ETHZMobil.npz, DYN-GPMPC-ETHZ.npz and "
            "DYN-NMPC-ETHZ.npz.",
        ),
    ] = None,
    raceline: GivenLine = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="DIR", help="Folder for page and figures.")
    ] = Path("runs/paper"),
    quick: Annotated[
        bool, typer.Option("--quick", help="Fewer samples, seeds and problems.")
    ] = False,
    seed: Annotated[
        int,
        typer.Option(
            min=0, max=2**32 - 1, metavar="N", help="Seed of training drives and of the GPs."
        ),
    ] = 0,
) -> None:
    """Make every figure and number of the paper from scratch, and compare them with it.

    Leaves paper.html, the figures as SVG and PDF, and numbers.json. What is computed is kept: the
    same command goes on after an interruption.
    """
    from operation.terminal.progress import stages_on
    from operation.terminal.terminal import Terminal
    from studies.paper.make import PaperSettings, make_paper

    console = Terminal()
    settings = PaperSettings(tracks, data, raceline, quick, seed)
    with stages_on(console) as stages:
        page, sections = make_paper(settings, out, stages)
    for finding in (one for section in sections for one in section.findings):
        console.print(
            f"{finding.verdict}: {finding.what}: {finding.ours}", highlight=False, soft_wrap=True
        )
    console.print(f"{page}", highlight=False, soft_wrap=True)
