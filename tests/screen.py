"""What a person sees on a terminal, of all that was written to it."""

from __future__ import annotations

import re
from typing import Final

_PART: Final = re.compile(r"\x1b\[\??([\d;]*)([A-Za-z])|(\r\n|\r|\n)|([^\x1b\r\n]+)|\x1b")


def screen_lines(text: str, width: int) -> list[str]:
    """The lines of a terminal of `width` columns and any number of lines, without blanks at their ends.

    Of control sequences it knows what a live display uses: colours, moves up, and erasing a line.
    """
    lines: list[list[str]] = [[]]
    row = column = 0
    for found in _PART.finditer(text):
        arguments, command, end, plain = found.groups()
        if command == "A":
            row = max(0, row - int(arguments or 1))
        elif command == "K":
            assert arguments == "2"
            lines[row] = []
        elif end:
            column = 0
            if "\n" in end:
                row += 1
        for character in filter(str.isprintable, plain or ""):
            if column == width:  # where a terminal goes on with the next line
                row, column = row + 1, 0
            lines += [[] for _ in range(len(lines), row + 1)]
            line = lines[row]
            line += " " * (column - len(line))
            line[column : column + 1] = [character]
            column += 1
        lines += [[] for _ in range(len(lines), row + 1)]
    return ["".join(line).rstrip() for line in lines]
