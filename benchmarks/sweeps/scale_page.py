"""The page and the picture of sweeps over more and more points."""

from typing import Any

from ..page import cell, in_words, png, subplots, table
from ..timing import ran_on
from .job import AT_ONCE, IN_MEMORY, SHARDS


def choice(result: dict[str, Any]) -> str:
    """One sentence: what to take."""
    rows = result["rows"]
    at_once = [row for row in rows if row["way"] == AT_ONCE][-1]
    own = [row for row in rows if row["way"] == IN_MEMORY]
    same = next(row for row in own if row["points"] == at_once["points"])
    last, kept = own[-1], [row for row in rows if row["way"] == SHARDS][-1]
    return (
        f"Take `sweep`: {short(last['points'])} growth rates in {last['seconds']:.3g} s and"
        f" {last['peak_beyond_base'] / 1e6:.0f} MB, of which the result is"
        f" {last['result_bytes'] / 1e6:.0f} MB, while one call of a vmapped program takes"
        f" {at_once['peak_beyond_base'] / same['peak_beyond_base']:.1f} times the memory and"
        f" {at_once['seconds'] / same['seconds']:.2f} times the time for {short(same['points'])}"
        f" points; name a folder (`out=`) where a sweep may be interrupted, which takes"
        f" {kept['seconds'] / last['seconds']:.2f} times the time."
    )


def short(count: float) -> str:
    """A number of points as a page shows it, 1e8."""
    mantissa, exponent = f"{count:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def megabytes(count: int | None) -> str:
    """Bytes as a table shows them."""
    return cell(None if count is None else count / 1e6, ".3g")


def ladder_table(result: dict[str, Any]) -> list[str]:
    """Time, memory, files and errors."""
    return table(
        [
            "way",
            "points",
            "time [s]",
            "points a second",
            "peak memory [MB]",
            "of it the result [MB]",
            "files",
            "on disk [MB]",
            "before the first batch is there [s]",
            "error beside single calls",
            "error to 40 digits",
        ],
        [
            [
                row["way"],
                short(row["points"]),
                f"{row['seconds']:.3g}",
                f"{row['points'] / row['seconds']:.3g}",
                megabytes(row["peak_beyond_base"]),
                megabytes(row["result_bytes"]),
                f"{row['files'] or '-'}",
                megabytes(row["disk_bytes"]),
                f"{row['compile_s']:.1f}",
                f"{row['off_single']:.0e}",
                f"{row['off_exact']:.0e}",
            ]
            for row in result["rows"]
        ],
    )


def killed_text(killed: dict[str, Any]) -> str:
    """What became of the sweep that was killed."""
    there = [str(kill["batches_there"]) for kill in killed["kills"]]
    lost = [str(kill["begun_but_not_there"]) for kill in killed["kills"]]
    how = "the same to the last bit as" if killed["equal_to_the_last_bit"] else "NOT equal to"
    return (
        f"A sweep of {short(killed['points'])} points in {killed['batches']} batches, killed by"
        f" SIGKILL when {', '.join(there)} of them were there and started again each time,"
        f" computed {killed['computed_again']} batches twice ({', '.join(lost)} were begun and"
        f" lost at each kill); its result is {how} that of a sweep left alone."
    )


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, what is wanted, the tables, how they were measured."""
    shared_rows = [
        [
            way["name"],
            str(way["device_count"]),
            f"{way['points_a_second']:.3g}",
            f"{way['beside_one']:.2f}",
        ]
        for way in result["shared"]
    ]
    equal = all(way["equal_to_the_last_bit"] for way in result["shared"])
    lines = [
        "# Scale: a sweep over more and more points",
        "",
        choice(result),
        "",
        *table(
            ["what", "found", "wanted", ""],
            [[entry["what"], *in_words(entry)] for entry in result["headline"]],
        ),
        "",
        "## More points",
        "",
        *ladder_table(result),
        "",
        "Growth rates of the reference brake over D, G, mu_s and V in double precision, each row"
        " in a Python process of its own on"
        f" {', '.join(sorted({row['device'] for row in result['rows']}))}. Time is the median of"
        f" {result['rows'][0]['repeats']} runs"
        + (", one run beyond 1e7 points" if not result["quick"] else "")
        + ", without compiling, which is in the column of the first batch. Peak memory is what was"
        " resident beyond what the process held before the clock started, which is"
        f" {max(row['base_bytes'] for row in result['rows']) / 1e6:.0f} MB at most: Python, JAX"
        f" and the program. Errors are the worst of {result['checked']} points drawn at random, in"
        " omega_1. One call of jax.vmap holds the grid and everything in between at once; more"
        " points than shown were not tried.",
        "",
        "## Interrupted",
        "",
        killed_text(result["interrupted"]),
        "",
        "## Shared",
        "",
        *table(["way", "devices in all", "points a second", "beside one"], shared_rows),
        "",
        f"{short(result['shared_points'])} points; devices are virtual ones of this processor, all"
        " on the same cores, and processes talk over the loopback address: this shows what sharing"
        " costs, not what more machines bring. Two processes each read back the whole. Ratios are"
        f" medians of those within each of {result['turns']} turns. The results of all ways and"
        f" processes are {'the same to the last bit' if equal else 'NOT the same'}.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


STYLES = {
    IN_MEMORY: ("o-", "tab:blue"),
    SHARDS: ("s--", "tab:orange"),
    AT_ONCE: ("^:", "tab:green"),
}


def picture(result: dict[str, Any]) -> bytes:
    """Time at the left, peak memory at the right, over the points."""
    figure, (left, right) = subplots(1, 2, figsize=(11, 4.8))
    for way, (style, colour) in STYLES.items():
        rows = [row for row in result["rows"] if row["way"] == way]
        points = [row["points"] for row in rows]
        drawn: dict[str, Any] = dict(c=colour, mec="k", label=way)
        left.plot(points, [row["seconds"] for row in rows], style, **drawn)
        right.plot(points, [row["peak_beyond_base"] / 1e6 for row in rows], style, **drawn)
    rows = [row for row in result["rows"] if row["way"] == IN_MEMORY]
    points = [row["points"] for row in rows]
    line = [rows[-1]["seconds"] * n / points[-1] for n in points]
    left.plot(points, line, "k", lw=0.8, alpha=0.6, label="in proportion to the points")
    needed = [row["result_bytes"] / 1e6 for row in rows]
    right.plot(points, needed, "k", lw=0.8, alpha=0.6, label="the result itself")
    left.set(ylabel="time [s]")
    right.set(ylabel="peak memory beyond the base [MB]")
    for ax in (left, right):
        ax.set(xscale="log", yscale="log", xlabel="points [-]")
        ax.grid(True, which="major", alpha=0.4)
        ax.legend(loc="upper left", fontsize="small")
    return png(figure, dpi=110)
