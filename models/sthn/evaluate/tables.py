"""Stored results -> the paper's tables, Markdown and CSV.

    python -m sthn.evaluate.tables RESULTS [RESULTS ...] [--out DIR]

`table_1`: MACE by D_C with the failure rate. `table_2`: CE and latency. `table_3`: MACE / CE by noise. `errors`: mean,
median, P95, P99, above 25 m and 50 m of both errors. `terrain`: the same by kind of ground. Results of several runs make
one table where their pairs are the same; else it is an error that names both.
"""

from __future__ import annotations

import argparse
import csv
import io
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from .metrics import Summary
from .quoted import MARK, paper, same_data
from .results import Cell, Condition, Results, ResultsError

LEAST_PAIRS = 100
"""Fewer pairs than this and the P99 is one pair."""


@dataclass
class Table:
    """Heads, rows of text, and what stands under it."""

    title: str
    heads: list[str]
    rows: list[list[str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def markdown(self) -> str:
        """With its notes."""
        lines = [f"## {self.title}", "", "| " + " | ".join(self.heads) + " |", "|" + "---|" * len(self.heads)]
        lines += ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in self.rows]
        return "\n".join(lines + [""] + [f"{note}\n" for note in self.notes])

    def csv(self) -> str:
        """Heads and rows alone."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([self.heads, *self.rows])
        return text.getvalue()


@dataclass(frozen=True)
class Entry:
    """A cell with where it comes from."""

    label: str
    condition: Condition
    cell: Cell
    results: Results


def gather(many: Iterable[Results]) -> list[Entry]:
    """All cells; those of one column must be of the same pairs."""
    entries: list[Entry] = []
    pairs: dict[tuple, tuple[str, Results]] = {}
    seen: dict[tuple, Results] = {}
    for results in many:
        for method in results.methods:
            for condition, cell in results.of(method.label):
                digest, first = pairs.setdefault(condition.key, (condition.digest, results))
                if digest != condition.digest:
                    names = f"{first.folder or first.command} and {results.folder or results.command}"
                    raise ResultsError(f"{condition_name(condition)}: expected the same pairs in {names}, found others")
                if (other := seen.setdefault((method.label, condition.key), results)) is not results:
                    names = f"{other.folder or other.command} and {results.folder or results.command}"
                    raise ResultsError(f"{method.label}, {condition_name(condition)}: expected one result, found two: {names}")
                entries.append(Entry(method.label, condition, cell, results))
    return entries


def condition_name(condition: Condition) -> str:
    """For people."""
    radius, noise = condition.key
    return f"D_C {radius:g} m" + ("" if noise == "none" else f", {noise}")


def labels(entries: list[Entry]) -> list[str]:
    """Rows, in the order of the runs."""
    return list(dict.fromkeys(entry.label for entry in entries))


def number(value: float | None, digits: int = 2) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def share(value: float | None) -> str:
    """As a percentage."""
    return "-" if value is None else f"{100 * value:.1f} %"


def _one(entries: list[Entry], label: str, radius: float, noise: str) -> Entry | None:
    return next((e for e in entries if e.label == label and e.condition.key == (radius, noise)), None)


def _value(entry: Entry | None, of: Callable[[Summary], str]) -> str:
    if entry is None or not entry.cell.scores:
        return "-"
    return of(entry.cell.summary())


def _row_note(entries: list[Entry], label: str) -> str:
    """What its cells say, each thing once."""
    return "; ".join(dict.fromkeys(e.cell.note for e in entries if e.label == label and e.cell.note))


def _notes(entries: list[Entry], quoted: bool) -> list[str]:
    """What every table says of its pairs."""
    counts = sorted({len(e.condition.pairs) for e in entries})
    sources = dict.fromkeys(str(e.results.source.get("name", "?")) for e in entries)
    count = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
    notes = [f"{count} pairs a column of {', '.join(sources)}, the same in every row."]
    if counts[0] < LEAST_PAIRS:
        notes.append(f"Fewer than {LEAST_PAIRS} pairs: a P99 is not more than the largest error.")
    if any(e.results.source.get("kind") == "flight" for e in entries):
        notes.append("A flight's truth is a place and a yaw: corner errors take its stated height for true, as `mace_m` does.")
    if quoted:
        data = paper()["data"]
        notes.append(
            f"{MARK}: the paper's own numbers, all {data['queries']} pairs of {data['name']} {data['split']}; not run here."
        )
    return notes


def may_quote(entries: list[Entry]) -> bool:
    """Whether every result of a table is on the paper's data."""
    return bool(entries) and all(same_data(e.results.source) for e in entries)


def table_1(entries: list[Entry]) -> Table:
    """MACE by D_C without noise, failure rate over all of them."""
    entries = [e for e in entries if e.condition.key[1] == "none"]
    radii = sorted({e.condition.search_radius_m for e in entries})
    table = Table("Table I: MACE (m) by D_C", ["method", *(f"{r:g}" for r in radii), "failure", "note"])
    for label in labels(entries):
        cells = [_one(entries, label, r, "none") for r in radii]
        scored = [c.cell.summary() for c in cells if c is not None and c.cell.scores]
        asked = sum(s.pairs for s in scored)
        failure = share(sum(s.failures for s in scored) / asked) if asked else "-"
        mace = [_value(c, lambda s: number(s.mace_m)) for c in cells]
        table.rows.append([label, *mace, failure, _row_note(entries, label)])
    if quoted := may_quote(entries):
        ours = paper()["table_1"]
        for row in ours["rows"]:
            value = dict(zip(ours["search_radius_m"], row["mace_m"], strict=True))
            cells = [number(value.get(int(r))) for r in radii]
            table.rows.append([f"{row['method']} ({MARK})", *cells, share(row.get("failure")), ""])
    table.notes = _notes(entries, quoted) if entries else []
    table.notes.append("MACE is the mean over answered pairs; the failure rate is the share of pairs without an answer.")
    return table


def table_2(entries: list[Entry], radius: float) -> Table:
    """CE and latency at one D_C without noise."""
    entries = [e for e in entries if e.condition.key == (radius, "none")]
    heads = ["method", "CE (m)", "latency (ms)", "by stage (ms)", "note"]
    table = Table(f"Table II: CE and latency, D_C = {radius:g} m", heads)
    for entry in entries:
        stages = ", ".join(f"{name} {value:.1f}" for name, value in entry.cell.stages_ms().items())
        ce = _value(entry, lambda s: number(s.ce_m))
        note = _row_note(entries, entry.label)
        table.rows.append([entry.label, ce, number(entry.cell.latency_ms(), 1), stages, note])
    ours = paper()["table_2"]
    quoted = may_quote(entries) and radius == ours["search_radius_m"]
    if quoted:
        for row in ours["rows"]:
            table.rows.append([f"{row['method']} ({MARK})", number(row["ce_m"]), number(row["latency_ms"], 1), "", "RTX 2080 Ti"])
    table.notes = _notes(entries, quoted) if entries else []
    machines = ", ".join(dict.fromkeys(str(e.results.source.get("machine", "")) for e in entries)).strip(", ")
    table.notes.append(
        f"Latency: median wall time of a pair, map features made anew for each ({machines or 'machine not recorded'})."
    )
    return table


def table_3(entries: list[Entry], radius: float) -> Table:
    """MACE / CE by noise at one D_C."""
    entries = [e for e in entries if e.condition.search_radius_m == radius]
    noises = sorted({e.condition.key[1] for e in entries}, key=_noise_order)
    names = labels(entries)
    quotes = paper()["table_3"] if may_quote(entries) and radius == paper()["table_3"]["search_radius_m"] else None
    extra = [f"{row['method']} ({MARK})" for row in quotes["rows"]] if quotes else []
    table = Table(f"Table III: MACE / CE (m) by noise, D_C = {radius:g} m", ["noise", *names, *extra])
    for noise in noises:
        row = [noise]
        for name in names:
            row.append(_value(_one(entries, name, radius, noise), lambda s: f"{number(s.mace_m)} / {number(s.ce_m)}"))
        for quote in quotes["rows"] if quotes else []:
            value = {n: (m, c) for n, m, c in zip(quotes["noise"], quote["mace_m"], quote["ce_m"], strict=True)}
            row.append(f"{value[noise][0]:.2f} / {value[noise][1]:.2f}" if noise in value else "-")
        table.rows.append(row)
    table.notes = _notes(entries, bool(quotes)) if entries else []
    return table


def _noise_order(name: str) -> tuple:
    kind, _, bound = name.partition(" ")
    order = ("none", "rotation", "scale", "perspective")
    known = kind in order and "+" not in name
    return (order.index(kind), float(bound or 0)) if known else (len(order), name)


ERRORS = ["CE", "median", "P95", "P99", "> 25 m", "> 50 m", "MACE", "corner median", "corner P95", "corner > 25 m"]


def error_cells(s: Summary) -> list[str]:
    """One row's numbers under [`ERRORS`]."""
    c, k = s.centre, s.corner
    shares = [share(c.over_25m), share(c.over_50m)]
    return [
        *(number(v) for v in (c.mean_m, c.median_m, c.p95_m, c.p99_m)),
        *shares,
        *(number(v) for v in (k.mean_m, k.median_m, k.p95_m)),
        share(k.over_25m),
    ]


def errors(entries: list[Entry]) -> Table:
    """Everything, a row for each method and condition."""
    table = Table("Errors (m)", ["method", "D_C", "noise", "pairs", "failure", *ERRORS, "latency ms"])
    for entry in entries:
        radius, noise = entry.condition.key
        head = [entry.label, f"{radius:g}", noise, str(len(entry.condition.pairs))]
        if not entry.cell.scores:
            table.rows.append([*head, entry.cell.note or "-", *["-"] * len(ERRORS), "-"])
            continue
        s = entry.cell.summary()
        table.rows.append([*head, share(s.failure_rate), *error_cells(s), number(entry.cell.latency_ms(), 1)])
    table.notes = _notes(entries, False) if entries else []
    table.notes.append(
        "Position error first (of the frame's middle), then corner error. Means and percentiles are of answered pairs, the "
        "shares above 25 m and 50 m of all pairs: one without an answer is above both."
    )
    return table


def by_terrain(entries: list[Entry]) -> Table:
    """Position errors by kind of ground, conditions apart."""
    table = Table("By terrain (m)", ["terrain", "method", "D_C", "noise", "pairs", "failure", *ERRORS])
    kinds = sorted({pair.terrain for e in entries for pair in e.condition.pairs} - {""})
    for kind in kinds:
        for entry in entries:
            zipped = zip(entry.condition.pairs, entry.cell.scores, strict=False)
            scores = [score for pair, score in zipped if pair.terrain == kind]
            if scores:
                s, (radius, noise) = Summary.of(scores), entry.condition.key
                table.rows.append([kind, entry.label, f"{radius:g}", noise, str(s.pairs), share(s.failure_rate), *error_cells(s)])
    return table


def tables(many: Iterable[Results]) -> dict[str, Table]:
    """Every table that the results fill, by the stem of its files."""
    entries = gather(many)
    if not entries:
        raise ResultsError("results: expected at least one method under one condition, found none")
    widest = max(e.condition.search_radius_m for e in entries)
    made = {"table_1": table_1(entries), "table_2": table_2(entries, widest)}
    if len({e.condition.key[1] for e in entries if e.condition.search_radius_m == widest}) > 1:
        made["table_3"] = table_3(entries, widest)
    made["errors"] = errors(entries)
    if (terrain := by_terrain(entries)).rows:
        made["terrain"] = terrain
    return {name: table for name, table in made.items() if table.rows}


def write(made: dict[str, Table], folder: Path, command: str) -> None:
    """`<name>.md` and `<name>.csv` of each, and `tables.md` with all."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in made.items():
        (folder / f"{name}.csv").write_text(table.csv())
        (folder / f"{name}.md").write_text(table.markdown())
    text = "\n".join(table.markdown() for table in made.values())
    (folder / "tables.md").write_text(f"# Evaluation\n\n`{command}`\n\n{text}")


def main(arguments: list[str] | None = None) -> int:
    """The command; returns its exit code."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(prog="python -m sthn.evaluate.tables", description=__doc__, formatter_class=raw)
    parser.add_argument("results", type=Path, nargs="+", help="results.json, or folders that hold one")
    parser.add_argument("--out", type=Path, help="folder of the files; none prints only")
    options = parser.parse_args(arguments)
    try:
        many = [Results.read(path) for path in options.results]
        made = tables(many)
    except ResultsError as error:
        print(f"tables: {error}", file=sys.stderr)
        return 1
    print("\n".join(table.markdown() for table in made.values()))
    if options.out:
        write(made, options.out, " ; ".join(results.command for results in many))
    return 0


if __name__ == "__main__":
    sys.exit(main())
