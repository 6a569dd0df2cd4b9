"""Draws what the figures of a paper can be drawn from some run folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.figure import Figure

from ato_hil.tools.papers import style
from ato_hil.tools.papers.afilc import figures as afilc
from ato_hil.tools.papers.cailc import figures as cailc
from ato_hil.tools.papers.drac import figures as drac
from ato_hil.tools.papers.iplc import figures as iplc
from ato_hil.tools.papers.mtcc import figures as mtcc
from ato_hil.tools.papers.style import Drawing
from ato_hil.tools.runs.files import write_bytes
from ato_hil.tools.runs.folder import Folder, FolderError, Missing

# The figures by paper, and the laws that are a scenario's default in that paper.
PAPERS: dict[str, tuple[tuple[Drawing, ...], tuple[str, ...]]] = {
    "cailc": (cailc.FIGURES, ("cailc", "ailc", "pdilc", "adaptive", "pid")),
    "drac": (drac.FIGURES, ("drac", "drac-robust", "drac-exact", "pid-feedforward")),
    "mtcc": (mtcc.FIGURES, ("mtcc", "mtcc-single", "mtcc-pid")),
    "afilc": (afilc.FIGURES, ("afilc", "afilc-track")),
    "iplc": (iplc.FIGURES, ("iplc", "norm-optimal")),
}


class Drawn(NamedTuple):
    """A figure, or why there is none."""

    paper: str
    drawing: Drawing
    figure: Figure | None
    why_not: str = ""

    @property
    def stem(self) -> str:
        """Of the file: cailc-fig6-speed-error."""
        return f"{self.paper}-fig{self.drawing.number}-{self.drawing.slug}"


def paper_of(folder: Folder) -> str:
    """The paper that the scenario of a folder stands for. Raises FolderError."""
    for paper, (_figures, laws) in PAPERS.items():
        if folder.scenario.law in laws:
            return paper
    raise FolderError(
        f"{folder.path}: scenario {folder.name} with law {folder.scenario.law!r} belongs to none of"
        f" the papers {', '.join(PAPERS)}"
    )


def figures(folders: list[Folder]) -> Iterator[Drawn]:
    """The figures of one paper, one after the other, from one or more folders.

    Raises FolderError if the folders belong to several papers, or a trace cannot be read.
    """
    papers = [paper_of(folder) for folder in folders]
    for folder, paper in zip(folders, papers, strict=True):
        if paper != papers[0]:
            raise FolderError(
                f"{folder.path} is of paper {paper}, {folders[0].path} of {papers[0]}"
            )
    for drawing in PAPERS[papers[0]][0]:
        with matplotlib.rc_context(style.SETTINGS):
            try:
                yield Drawn(papers[0], drawing, drawing.draw(folders))
            except Missing as reason:
                yield Drawn(papers[0], drawing, None, str(reason))


def write(drawn: Drawn, out: Path, formats: Sequence[str]) -> list[Path]:
    """Writes a figure into a folder, a file for each format; the files. Raises FolderError."""
    assert drawn.figure is not None
    files = [out / f"{drawn.stem}.{kind}" for kind in formats]
    try:
        out.mkdir(parents=True, exist_ok=True)
        for file in files:
            write_bytes(file, style.bytes_of(drawn.figure, file.suffix[1:]))
    except OSError as error:
        raise FolderError(f"{out}: cannot write there: {error.strerror}") from None
    return files
