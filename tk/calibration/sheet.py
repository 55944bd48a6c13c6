"""Write a board as a PDF to print, in its true size."""

from __future__ import annotations

import math
from pathlib import Path

from tk.calibration.boards import Board, make_board
from tk.errors import ConfigError
from tk.io.paths import Kind, check_output, looks_like, replacing


def _papers() -> dict[str, tuple[int, int]]:
    """Return width and height of sheets of paper held across, millimetres: each is half of the one before."""
    sides = [1189, 841]
    while len(sides) < 6:
        sides.append(sides[-2] // 2)
    return {f"A{n}": (sides[n], sides[n + 1]) for n in range(5)}


#: width and height of a sheet of paper held across, millimetres
PAPERS = _papers()
#: edge that printers leave white, and room for the text below the board, millimetres
_EDGE_MM, _TEXT_MM = 8.0, 14.0
#: PostScript points in a millimetre
_POINT = 72 / 25.4

SHEET = Kind("a PDF", (".pdf",), looks_like(rb"%PDF-"))


def fitted_square_m(kind: str, size: str | None, paper: str, marker: float | None, dictionary: str | None) -> float:
    """Return the side of the largest square, whole millimetres (half ones below 20), with which a board fits on paper.

    Raises:
        ConfigError: the board has too many squares for the paper.
    """
    width, height = PAPERS[paper]
    unit = make_board(kind, size, 0.1, marker, dictionary)
    across, down = (side / unit.square_m for side in unit.size_m)
    side = min((width - 2 * _EDGE_MM) / across, (height - 2 * _EDGE_MM - _TEXT_MM) / down)
    step = 1.0 if side >= 20 else 0.5
    side = math.floor(side / step + 1e-9) * step
    if side < 5:
        raise ConfigError(f"--paper {paper}: {unit.title} would have squares of {side:g} mm; take larger paper")
    return side / 1000


def write_sheet(path: Path, board: Board, paper: str, force: bool) -> None:
    """Write the board as a PDF of one page, with a line of text that says what it is and a bar of 100 mm.

    Raises:
        ConfigError: the board is larger than the paper.
        TkError: the file cannot be written.
    """
    check_output(path, SHEET, force)
    width, height = PAPERS[paper]
    across, down = (1000 * side for side in board.size_m)
    if across > width - _EDGE_MM or down > height - _TEXT_MM:
        raise ConfigError(f"--square: a board of {across:.0f}x{down:.0f} mm is larger than {paper}; leave --square out")
    left, top = (width - across) / 2, (height - _TEXT_MM - down) / 2
    lines = ["0 g 0 G 1 J"]  # black, a pen with a round tip
    for shape in board.shapes():
        x, y = left + 1000 * shape.x, height - top - 1000 * (shape.y + shape.height)
        if shape.round:
            dot = f"{_pt(x + 500 * shape.width)} {_pt(y + 500 * shape.height)}"
            lines.append(f"{_pt(1000 * shape.width)} w {dot} m {dot} l S")
        else:
            lines.append(f"{_pt(x)} {_pt(y)} {_pt(1000 * shape.width)} {_pt(1000 * shape.height)} re f")
    options = f"--board {board.kind} --size {board.columns}x{board.rows} --square {board.square_m:g}"
    if board.kind in ("charuco", "aprilgrid"):
        options += f" --dictionary {board.dictionary}" + f" --marker {board.marker:g}"
    name = {"circles": "rows", "aprilgrid": "tags"}.get(board.kind, "squares")
    text = (
        f"tk calibrate {options}    {name} of {1000 * board.square_m:g} mm on {paper}: print at 100 %, glue to a flat "
        "plate, measure; this bar is 100 mm"
    )
    x0, y0 = _EDGE_MM + 2, _EDGE_MM
    lines += [f"{_pt(x0)} {_pt(y0)} {_pt(100)} {_pt(1)} re f"]
    lines += [f"{_pt(x0 + d)} {_pt(y0)} {_pt(0.4)} {_pt(3)} re f" for d in (0, 99.6)]
    points = min(9.0, (width - 2 * _EDGE_MM - 4) * _POINT / (0.5 * len(text)))
    lines.append(f"BT /F1 {points:.1f} Tf {_pt(x0)} {_pt(y0 + 5)} Td ({_escaped(text)}) Tj ET")
    with replacing(path) as part:
        part.write_bytes(_document(width, height, "\n".join(lines)))


def _pt(millimetres: float) -> str:
    return f"{millimetres * _POINT:.4f}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")


def _document(width: float, height: float, content: str) -> bytes:
    """Return a PDF 1.4 file of one page."""
    stream = content.encode("latin-1", "replace")
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {_pt(width)} {_pt(height)}] /Contents 4 0 R "
        "/Resources << /Font << /F1 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%s\nendstream" % (len(stream), stream),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, places = b"%PDF-1.4\n", []
    for number, body in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    end = f"trailer << /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(out)}\n%%EOF\n".encode()
    return out + b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1) + table + end
