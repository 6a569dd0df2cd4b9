"""Draws what the figures of a paper can be drawn from some run folders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
from matplotlib.figure import Figure

from ato_hil.tools import papers
from ato_hil.tools.papers import neutral, style
from ato_hil.tools.papers.style import Drawing
from ato_hil.tools.runs.files import write_bytes
from ato_hil.tools.runs.folder import Folder, FolderError, Missing


class Drawn(NamedTuple):
    """A figure, or why there is none."""

    paper: str  # "" for none
    drawing: Drawing
    figure: Figure | None
    caption: str  # with the runs that are shown
    why_not: str = ""

    @property
    def stem(self) -> str:
        """Of the file: cailc-fig6-speed-error; that of no paper speed-error."""
        slug = self.drawing.slug
        return f"{self.paper}-fig{self.drawing.number}-{slug}" if self.paper else slug


def paper_of(folder: Folder) -> str:
    """The paper that a folder's scenario stands for and its law belongs to; "" if there is none: a
    paper's captions and numbers are not those of a law of one's own."""
    for paper in papers.names():
        if {folder.scenario.law, folder.law} <= set(papers.part(paper).LAWS):
            return paper
    return ""


def figures(folders: list[Folder]) -> Iterator[Drawn]:
    """The figures of one paper, one after the other, from one or more folders; neutral ones where a
    folder is of none.

    Raises FolderError if the folders belong to several papers, or a trace cannot be read.
    """
    of_folders = [paper_of(folder) for folder in folders]
    paper = "" if "" in of_folders else of_folders[0]
    for folder, other in zip(folders, of_folders, strict=True):
        if paper and other != paper:
            raise FolderError(f"{folder.path} is of paper {other}, {folders[0].path} of {paper}")
    source = papers.part(paper, "figures") if paper else neutral
    drawings: tuple[Drawing, ...] = source.FIGURES
    for drawing in drawings:
        with matplotlib.rc_context(style.settings()):
            try:
                figure = drawing.draw(folders)
                yield Drawn(paper, drawing, figure, _caption(drawing, folders))
            except Missing as reason:
                yield Drawn(paper, drawing, None, drawing.caption, str(reason))


def _caption(drawing: Drawing, folders: list[Folder]) -> str:
    if drawing.runs is None:
        return drawing.caption
    *others, last = (str(run) for run in dict.fromkeys(drawing.runs(folders)))
    shown = f"runs {', '.join(others)} and {last}" if others else f"run {last}"
    return f"{drawing.caption} in {shown}"


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
