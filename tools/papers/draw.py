"""Draws what the figures of a paper can be drawn from some run folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.figure import Figure

from ato_hil.tools import papers
from ato_hil.tools.papers import style
from ato_hil.tools.papers.style import Drawing
from ato_hil.tools.runs.files import write_bytes
from ato_hil.tools.runs.folder import Folder, FolderError, Missing


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
    for paper in papers.names():
        if folder.scenario.law in papers.part(paper).LAWS:
            return paper
    raise FolderError(
        f"{folder.path}: scenario {folder.name} with law {folder.scenario.law!r} belongs to none of"
        f" the papers {', '.join(papers.names())}"
    )


def figures(folders: list[Folder]) -> Iterator[Drawn]:
    """The figures of one paper, one after the other, from one or more folders.

    Raises FolderError if the folders belong to several papers, or a trace cannot be read.
    """
    paper = paper_of(folders[0])
    for folder in folders[1:]:
        if paper_of(folder) != paper:
            raise FolderError(
                f"{folder.path} is of paper {paper_of(folder)}, {folders[0].path} of {paper}"
            )
    drawings: tuple[Drawing, ...] = papers.part(paper, "figures").FIGURES
    for drawing in drawings:
        with matplotlib.rc_context(style.settings()):
            try:
                yield Drawn(paper, drawing, drawing.draw(folders))
            except Missing as reason:
                yield Drawn(paper, drawing, None, str(reason))


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
