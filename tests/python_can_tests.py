"""Fetches python-can's own tests into a folder: `python python_can_tests.py FOLDER`.

They come from the source distribution of the installed version: the wheel has none.
"""

import re
import subprocess
import sys
import tarfile
from pathlib import Path

import can


def fetch(folder: Path) -> None:
    """Download the sources and unpack their tests into FOLDER/test."""
    name = f"python-can=={can.__version__}"
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
    command += ["--no-binary", "python-can", "--dest", str(folder), name]
    subprocess.run(command, check=True, timeout=300)
    (archive,) = folder.glob(f"python_can-{can.__version__}.tar.gz")
    (folder / "test").mkdir(exist_ok=True)
    with tarfile.open(archive) as sources:
        # The package itself stays packed: the installed one is to be tested.
        for member in sources.getnames():
            if re.fullmatch(r"[^/]+/test/\w+\.py", member):
                content = sources.extractfile(member).read()  # type: ignore[union-attr]
                (folder / "test" / Path(member).name).write_bytes(content)


if __name__ == "__main__":
    fetch(Path(sys.argv[1]))
