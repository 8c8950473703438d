"""One HTML file with everything in it: tables, plots, and one view at each level side by side."""

import base64
import html
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from freqgs_plugin.reports.bench.tables import BenchTable
from freqgs_plugin.reports.drawing import HeldOutView
from freqgs_plugin.reports.report.circumstances import sentence
from freqgs_plugin.reports.report.drawn import OPAQUE, Subset
from freqgs_plugin.reports.report.page import caption, remarks

SHOWN_PARTS = 6
"""of a run, beside the photograph"""
_LOSSLESS = 500_000
"""pixels of a picture up to which it is kept as PNG; larger ones as JPEG"""
_JPEG_QUALITY = 95

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; padding: 0 1rem; max-width: 1500px; color: #222; }
h1, h2, h3 { line-height: 1.2; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: 3px 9px; text-align: right; border-bottom: 1px solid #ddd; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
th { border-bottom: 2px solid #888; }
.note, .circumstances, figcaption { color: #555; font-size: 13px; }
.plot img { max-width: 100%; height: auto; }
figure { margin: 0; }
.views { display: flex; flex-wrap: wrap; gap: 8px; }
.views figure { flex: 1 1 300px; }
.views img { display: block; max-width: 100%; height: auto; }
ul.remarks { background: #fff6dd; padding: 0.6rem 1rem 0.6rem 2rem; border-left: 4px solid #e69f00; }
""".strip()


def html_page(
    record: Mapping[str, Any],
    tables: Sequence[BenchTable],
    plots: Mapping[str, bytes],
    drawn: Sequence[Sequence[Subset]],
) -> str:
    """The page; `plots` are PNG files by name, `drawn` the subsets of each run. It asks for nothing from elsewhere."""
    view = len(drawn[0][0].of.views) // 2
    parts = ["<h1>Report</h1>", f'<p class="circumstances">{_inline(sentence(record))}</p>']
    if found := remarks(record):
        lines = "".join(f"<li>{_inline(line)}</li>" for line in found)
        parts.append(f'<ul class="remarks">{lines}</ul>')
    for name, png in plots.items():
        source = _uri(png, "image/png")
        text = _inline(caption(name))
        parts.append(f'<figure class="plot"><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>')
    parts += [_pictures(record, drawn, view)]
    for table in tables:
        note = f'<p class="note">{_inline(table.note)}</p>' if table.note else ""
        parts.append(f"<h2>{_text(table.title)}</h2>{_table(table)}{note}")
    title = _text(", ".join(run["name"] for run in record["runs"]))
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>freqgs report: {title}</title>\n<style>\n{_STYLE}\n</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _pictures(record: Mapping[str, Any], drawn: Sequence[Sequence[Subset]], number: int) -> str:
    """One view: the photograph and each level of every run in a row."""
    first: HeldOutView = drawn[0][0].of.views[number]
    photo = _figure(_bytes(first.image.cpu().numpy()), "photograph", first.name)
    rows = [f"<h2>One view at each level: {_text(first.name)}</h2>"]
    for run, each in zip(record["runs"], drawn, strict=True):
        points = [point for series in run["series"] for point in series["points"]]
        shown = _some([(s, p) for s, p in zip(each, points, strict=True) if s.series in ("", OPAQUE)])
        figures = [photo, *(_drawn_figure(subset, point, number) for subset, point in shown)]
        way = f", {OPAQUE}" if run["kind"] == "shares" else ""
        rows.append(f"<h3>{_text(run['name'] + way)}</h3><div class='views'>{''.join(figures)}</div>")
    kept = "PNG, as it is" if first.image.shape[0] * first.image.shape[1] <= _LOSSLESS else "JPEG"
    note = f"Pictures shrink to fit; each is kept as {kept}. Figures are means over all views."
    rows.append(f'<p class="note">{note}</p>')
    return "\n".join(rows)


def _some(parts: Sequence[tuple[Subset, Mapping[str, Any]]]) -> list[tuple[Subset, Mapping[str, Any]]]:
    """At most `SHOWN_PARTS`, the first and the last among them."""
    if len(parts) <= SHOWN_PARTS:
        return list(parts)
    return [parts[round(i * (len(parts) - 1) / (SHOWN_PARTS - 1))] for i in range(SHOWN_PARTS)]


def _drawn_figure(subset: Subset, point: Mapping[str, Any], number: int) -> str:
    picture = subset.draw(subset.of.views[number].camera).features.clamp(0, 1).cpu().numpy()
    text = (
        f"{point['psnr']:.2f} dB, {point['drawn']:,.0f} Gaussians, {point['bytes'] / 1e6:.2f} MB, "
        f"{point['render']['median_ms']:.1f} ms"
    )
    return _figure(_bytes(picture), subset.label, text)


def _figure(picture: UInt8[np.ndarray, "h w 3"], name: str, text: str) -> str:
    height, width = picture.shape[:2]
    return (
        f'<figure style="max-width: {width}px">'
        f'<img src="{_encoded(picture)}" width="{width}" height="{height}" alt="{_text(name)}">'
        f"<figcaption><b>{_text(name)}</b><br>{_text(text)}</figcaption></figure>"
    )


def _bytes(picture: np.ndarray) -> UInt8[np.ndarray, "h w 3"]:
    return np.round(np.nan_to_num(np.clip(picture, 0, 1)) * 255).astype(np.uint8)


def _encoded(picture: UInt8[np.ndarray, "h w 3"]) -> str:
    file, small = io.BytesIO(), picture.shape[0] * picture.shape[1] <= _LOSSLESS
    image = Image.fromarray(picture)
    if small:
        image.save(file, "PNG", optimize=True)
    else:
        image.save(file, "JPEG", quality=_JPEG_QUALITY)
    return _uri(file.getvalue(), "image/png" if small else "image/jpeg")


def _uri(contents: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(contents).decode()}"


def _table(table: BenchTable) -> str:
    head = "".join(f"<th>{_text(heading)}</th>" for heading, _ in table.columns)
    lines = ("".join(f"<td>{_text(cell)}</td>" for cell in line) for line in table.cells())
    rows = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table></div>'


def _text(text: str) -> str:
    return html.escape(text)


def _inline(markdown: str) -> str:
    """The little Markdown that notes use: *emphasis*, **strength** and `code`."""
    import re

    text = _text(markdown).replace("\\*", "&#42;")
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"\*\*([^*]+)\*\*", r"<strong>\1</strong>", text)
    return re.sub(r"\*([^*]+)\*", r"<em>\1</em>", text)
