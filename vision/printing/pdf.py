"""A page as PDF 1.4, in true size: filled rectangles and some text in Helvetica, which every viewer has."""

from __future__ import annotations

from .sheet import Page, Rectangle, Text

POINT_MM = 25.4 / 72.0


def pdf(page: Page) -> bytes:
    """Return the bytes of the file."""
    width, height = (side / POINT_MM for side in page.size_mm)
    content = [*(_rectangle(each, page) for each in page.rectangles), "f", *(_text(each, page) for each in page.texts)]
    stream = "\n".join(["0 g", *content]).encode("latin-1")
    return _file(
        b"<</Type/Catalog/Pages 2 0 R/ViewerPreferences<</PrintScaling/None>>>>",
        b"<</Type/Pages/Kids[3 0 R]/Count 1>>",
        f"<</Type/Page/Parent 2 0 R/MediaBox[0 0 {width:.4f} {height:.4f}]/Contents 4 0 R"
        "/Resources<</Font<</F 5 0 R>>>>>>".encode(),
        b"<</Length %d>>stream\n%b\nendstream" % (len(stream), stream),
        b"<</Type/Font/Subtype/Type1/BaseFont/Helvetica/Encoding/WinAnsiEncoding>>",
    )


def _rectangle(black: Rectangle, page: Page) -> str:
    # PDF counts y upwards from the sheet's lower edge.
    y = page.size_mm[1] - black.y_mm - black.height_mm
    sides = (black.x_mm, y, black.width_mm, black.height_mm)
    return f"{' '.join(f'{side / POINT_MM:.4f}' for side in sides)} re"


def _text(text: Text, page: Page) -> str:
    x, y = text.x_mm / POINT_MM, (page.size_mm[1] - text.y_mm) / POINT_MM
    turn = "0 1 -1 0" if text.turned else "1 0 0 1"
    words = text.text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    return f"BT /F {text.size_mm / POINT_MM:.3f} Tf {turn} {x:.4f} {y:.4f} Tm ({words}) Tj ET"


def _file(*objects: bytes) -> bytes:
    """Return objects from number 1 on, catalogue first, with their cross-reference table (PDF 32000-1:2008, 7.5)."""
    out = bytearray(b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n")
    places = []
    for number, content in enumerate(objects, 1):
        places.append(len(out))
        out += b"%d 0 obj\n%b\nendobj\n" % (number, content)
    table = len(out)
    out += b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1)
    out += b"".join(b"%010d 00000 n \n" % place for place in places)
    out += b"trailer\n<</Size %d/Root 1 0 R>>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, table)
    return bytes(out)
