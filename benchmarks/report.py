"""The results as a table and as pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.measure import Row
from warpgarment.view.markdown import table

TITLES = {
    "geodesics": "Distances over the cloth",
    "stages": "Stages against the published way",
    "batch": "Whole frames, per garment",
    "roofline": "The network against the device",
    "teacher": "Whole frames against the teacher",
    "profile": "Within a frame",
}
_TEXT = ("what", "network", "reference", "beside", "bound by", "target", "reached", "met")
INTRODUCTIONS = {
    "geodesics": "Between the centroids of all faces, of a garment that is seen for the first time.",
    "stages": "Ratio: least time of the reference over ours; references run on the CPU. Off: distance at worst [mm] "
    "from the exact answer in float64; references are given right-hand sides, contacts and matrices.",
    "batch": "Garments on bodies of their own. Ratio: a Python loop over the garments over the batch, in the same run.",
    "roofline": "Achieved: the least time that the measured rates allow, over the least time measured.",
    "teacher": "Ratio: least time of Newton's VBD over ours.",
    "profile": "Counted with all decisions left to the device. Host reads are what a GPU would be waited for.",
}


def markdown(about: dict[str, str], command: str, rows: Sequence[Row]) -> str:
    """The results as tables in Markdown, one per part."""
    lines = ["# " + ", ".join(f"{k} {v}" for k, v in about.items()), "", f"`{command}`", ""]
    lines += [
        "Milliseconds, least and median: of the processor on a CPU, all threads together; by the clock on a GPU.",
        "",
    ]
    lines += _targets([row for row in rows if "target" in row])
    for part, title in TITLES.items():
        of_part = [row for row in rows if row["part"] == part]
        if not of_part:
            continue
        lines += [f"## {title}", "", INTRODUCTIONS[part], ""]
        if part == "profile":
            lines += _profile(of_part)
        elif part == "roofline":
            lines += _roofline(of_part)
        else:
            lines += _times([row for row in of_part if "min_ms" in row or "median_ms" in row or "note" in row])
        lines.append("")
    return "\n".join(lines)


def _targets(rows: Sequence[Row]) -> list[str]:
    if not rows:
        return []
    lines = ["## Targets", "", "Time targets hold for medians; ratios are of least times.", ""]
    names = ["faces", "batch", "what", "beside", "target", "reached", "met"]
    shown = []
    for row in rows:
        what = " ".join([row["what"], *([f"({row['network']})"] if "network" in row else [])])
        cells = [_count(row, "faces"), _count(row, "batch"), what, row.get("reference", "-")]
        shown.append([*cells, row["target"], row["reached"], "yes" if row["met"] else "**no**"])
    return [*lines, *table(names, shown, text=_TEXT), ""]


def _times(rows: Sequence[Row]) -> list[str]:
    """A table of times; columns that no row has are left out."""
    columns = {
        "faces": lambda row: _count(row, "faces"),
        "batch": lambda row: _count(row, "batch"),
        "network": lambda row: row.get("network", "-"),
        "what": lambda row: row["what"],
        "min": lambda row: _ms(row, "min_ms"),
        "median": lambda row: _ms(row, "median_ms"),
        "off": lambda row: _off(row, "error_mm"),
        "predicted MB": lambda row: f"{row['memory_mb']:,.0f}" if "memory_mb" in row else "-",
        "reference": lambda row: f"{row.get('reference', '')} {row.get('note', '')}".strip() or "-",
        "min of it": lambda row: _ms(row, "reference_min_ms"),
        "median of it": lambda row: _ms(row, "reference_median_ms"),
        "off by it": lambda row: _off(row, "reference_error_mm"),
        "ratio": lambda row: f"{row['ratio']:.2f}" if "ratio" in row else "-",
    }
    shown = {name: [cell(row) for row in rows] for name, cell in columns.items()}
    shown = {name: cells for name, cells in shown.items() if set(cells) != {"-"}}
    return table(list(shown), zip(*shown.values(), strict=True), text=_TEXT)


def _roofline(rows: Sequence[Row]) -> list[str]:
    lines = []
    for row in rows:
        if row["what"].startswith("device: "):
            lines.append(f"- {row['what'][8:]}: {row['rate'] / 1e9:,.1f} G")
    names = [
        "faces",
        "batch",
        "network",
        "what",
        "min",
        "median",
        "GFLOP",
        "MB",
        "floor",
        "bound by",
        "GFLOP/s",
        "achieved",
    ]
    shown = []
    for row in rows:
        if row["what"].startswith("device: "):
            continue
        cells = [_count(row, "faces"), _count(row, "batch"), row.get("network", "-"), row["what"]]
        if "note" in row:
            cells += ["-"] * 5 + [row["note"], "-", "-"]
        else:
            cells += [_ms(row, "min_ms"), _ms(row, "median_ms"), f"{row['operations'] / 1e9:.2f}"]
            cells += [f"{row['bytes'] / 1e6:.0f}", _ms(row, "floor_ms"), row["bound"]]
            cells += [f"{row['rate'] / 1e9:,.1f}", f"{row['achieved']:.0%}"]
        shown.append(cells)
    return [*lines, "", *table(names, shown, text=_TEXT)]


def _profile(rows: Sequence[Row]) -> list[str]:
    keys = ["warp_launches", "torch_operators", "refits", "host_reads", "synchronisations", "launches"]
    keys += ["graph_launches", "copies"]
    names = ["faces", "batch", "network", "what", *(key.replace("_", " ") for key in keys)]
    shown = []
    for row in rows:
        cells = [_count(row, "faces"), _count(row, "batch"), row.get("network", "-"), row["what"]]
        if "note" in row:
            cells[-1] += f": {row['note']}"
        shown.append(cells + [f"{row[key]:g}" if key in row else "-" for key in keys])
    return table(names, shown, text=_TEXT)


def _count(row: Row, key: str) -> str:
    return f"{row[key]:,}" if key in row else "-"


def _ms(row: Row, key: str) -> str:
    return f"{row[key]:,.3g}" if row.get(key, 1000.0) < 100.0 else f"{row[key]:,.0f}" if key in row else "-"


def _off(row: Row, key: str) -> str:
    return f"{row[key]:.1e}" if key in row else "-"


def plot(path: Path, about: dict[str, str], rows: Sequence[Row]) -> None:
    """Draws the measured parts: ratios by stage, time over batch, roofline."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    timed = [row for row in rows if "note" not in row]
    panels = [(draw, part) for draw, part in _PANELS if any(row["part"] == part for row in timed)]
    figure, axes = pyplot.subplots(1, max(1, len(panels)), figsize=(6.2 * max(1, len(panels)), 5.0), squeeze=False)
    for axis, (draw, part) in zip(axes[0], panels, strict=False):
        draw(axis, [row for row in timed if row["part"] == part])
    figure.suptitle(f"{about['device']}, torch {about['torch']}, {about['torch threads']} threads", fontsize=9)
    figure.tight_layout()
    figure.savefig(path, dpi=110, format="png")
    pyplot.close(figure)


def _ratios(axis, rows: Sequence[Row]) -> None:
    def name(row: Row) -> str:
        return re.sub(r", \d.*", "", row["what"]) + f"\n{row['reference']}"  # without its number of contacts

    rows = [row for row in rows if "ratio" in row]
    names = list(dict.fromkeys(name(row) for row in rows))
    sizes = sorted({row["faces"] for row in rows})
    for k, size in enumerate(sizes):
        ratios = {name(row): row["ratio"] for row in rows if row["faces"] == size}
        at = [i + 0.8 * (k + 0.5) / len(sizes) - 0.4 for i, n in enumerate(names) if n in ratios]
        axis.plot([ratios[n] for n in names if n in ratios], at, "o", markersize=5, label=f"{size:,} faces")
    axis.set_yticks(range(len(names)), names, fontsize=6)
    axis.grid(axis="x", alpha=0.3)
    axis.invert_yaxis()
    axis.set_xscale("log")
    axis.axvline(1.0, color="black", linewidth=0.8)
    axis.set_xlabel("time of the reference / ours")
    axis.set_title(TITLES["stages"], fontsize=9)
    axis.legend(fontsize=6)


def _batches(axis, rows: Sequence[Row]) -> None:
    rows = [row for row in rows if row["what"] == "frame per garment"]
    networks = list(dict.fromkeys(row["network"] for row in rows))
    for k, size in enumerate(sorted({row["faces"] for row in rows})):
        for network, style in zip(networks, ("-", "--", ":", "-.") * len(networks), strict=False):
            series = [row for row in rows if row["faces"] == size and row["network"] == network]
            series.sort(key=lambda row: row["batch"])
            batches, drawn = [row["batch"] for row in series], {"color": f"C{k % 10}"}
            label = f"{size:,} faces, {network}"
            axis.plot(batches, [row["min_ms"] for row in series], "o", linestyle=style, label=label, **drawn)
            loops = [row for row in series if "ratio" in row]
            drawn |= {"marker": "x", "linestyle": "none"}
            axis.plot([row["batch"] for row in loops], [row["reference_min_ms"] for row in loops], **drawn)
    axis.set_xscale("log", base=2)
    axis.set_yscale("log")
    axis.axhline(1e3 / 30, color="black", linewidth=0.8)
    axis.set_xlabel("garments in a batch (x: one by one; black line: 30 frames a second)")
    axis.set_ylabel("ms per garment and frame")
    axis.set_title(TITLES["batch"], fontsize=9)
    axis.legend(fontsize=7)


def _roofs(axis, rows: Sequence[Row]) -> None:
    rates = {row["what"][8:].split(",")[0]: row["rate"] for row in rows if row["what"].startswith("device: ")}
    points = [row for row in rows if "operations" in row]
    where = [row["operations"] / row["bytes"] for row in points] or [1.0]
    intensity = np.geomspace(min(0.5, *where) / 2, 4 * max(where), 200)
    networks = list(dict.fromkeys(row["network"] for row in points))
    for name, colour in (("float32", "tab:blue"), ("bfloat16", "tab:orange")):
        roof = np.minimum(rates[name], intensity * rates["copy"])
        axis.plot(intensity, roof / 1e9, color=colour, label=f"{name}, measured roof")
        for network, marker in zip(networks, "o^sD" * len(networks), strict=False):
            series = [row for row in points if row["what"].endswith(name) and row["network"] == network]
            at = [row["operations"] / row["bytes"] for row in series]
            rates_of = [row["rate"] / 1e9 for row in series]
            axis.scatter(at, rates_of, color=colour, s=18, marker=marker, label=f"{name}, {network}")
            for x, y, row in zip(at, rates_of, series, strict=True):
                place = {"xytext": (4, -8), "textcoords": "offset points", "fontsize": 5, "color": colour}
                axis.annotate(f"{row['faces']:,} x {row['batch']}", (x, y), **place)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.set_xlabel("operations per byte")
    axis.set_ylabel("GFLOP/s")
    axis.set_title(f"{TITLES['roofline']} (faces x batch)", fontsize=9)
    axis.legend(fontsize=7)


_PANELS = ((_ratios, "stages"), (_batches, "batch"), (_roofs, "roofline"))
