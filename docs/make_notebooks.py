"""Write a notebook beside every tutorial: its text and its Python, without any output.

./run python docs/make_notebooks.py
"""

import json
import re
from pathlib import Path


FOLDER = Path(__file__).parent / "tutorials"
BLOCK = re.compile(r"^```python\n(.*?)^```\n", re.S | re.M)


def notebook(text: str) -> str:
    """The notebook of a page, as JSON."""
    parts = BLOCK.split(text)  # text, code, text, ...
    cells = [cell(part.strip("\n"), code=bool(k % 2)) for k, part in enumerate(parts)]
    about = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    whole = {"cells": [c for c in cells if c["source"]], "metadata": about}
    for k, made in enumerate(whole["cells"]):
        made["id"] = f"cell-{k}"
    whole |= {"nbformat": 4, "nbformat_minor": 5}
    return json.dumps(whole, indent=1, ensure_ascii=False) + "\n"


def cell(text: str, code: bool) -> dict:
    source = text.splitlines(keepends=True)
    if not code:
        return {"cell_type": "markdown", "metadata": {}, "source": source}
    return {
        "cell_type": "code",
        "execution_count": None,
        "metadata": {},
        "outputs": [],
        "source": source,
    }


def main() -> None:
    for page in sorted(FOLDER.glob("*.md")):
        if BLOCK.search(page.read_text()):
            page.with_suffix(".ipynb").write_text(notebook(page.read_text()))


if __name__ == "__main__":
    main()
