"""What the page of many limit cycles says and shows."""

from typing import Any

from fractaljax.motion import transient

from ..page import cell, png, subplots, table, verdict
from ..timing import ran_on


def rate(found: dict[str, Any]) -> float:
    """Cycles a second."""
    return 1 / found["seconds_a_cycle"]


def choice(result: dict[str, Any]) -> str:
    """Which method to take for many cycles, in one sentence."""
    one, two = result["methods"][:2]
    text = (
        f"Take `jax.vmap` over `fj.limit_cycle`: {rate(one):.0f} cycles a second on one device,"
        f" {rate(two):.0f} over {two['devices']} with `jax.shard_map`, errors up to"
        f" {two['error']['worst']:.0e}"
    )
    for head in result["headline"]:
        text += (
            f"; {head['what'].split(': ')[1].split(' against')[0]} is {head['ratio']:.1f} times as"
            f" fast as the best peer on as many cores (wanted >= {head['wanted']}:"
            f" {verdict(head)})"
        )
    return text + "."


HEADINGS = [
    "method",
    "devices or cores",
    "cycles",
    "compile [s]",
    "cycles a second",
    "error: median, worst",
    "results",
]


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, the tables, how they were measured."""
    rows = result["methods"]
    own = [found for found in rows if "results" in found]
    low, high = result["range"]
    lines = [
        "# Many limit cycles",
        "",
        choice(result),
        "",
        *table(
            HEADINGS,
            [
                [
                    found["name"],
                    str(found["devices"]),
                    str(found["cycles"]),
                    cell(found["compile_s"], ".1f"),
                    f"{rate(found):.0f}",
                    f"{found['error']['median']:.0e}, {found['error']['worst']:.0e}",
                    ", ".join(f"{n} {name}" for name, n in found.get("results", {}).items()) or "-",
                ]
                for found in rows
            ],
        ),
        "",
        f"K_n {low:.0e} to {high:.0e} N/m; medians of {result['repeats']} calls, the"
        " methods taking turns. Errors are relative, of period and amplitude, against the package"
        f" with {result['fine']} segments, of which {result['not_converged_with_fine']} of"
        f" {own[0]['cycles']} did not converge. The devices are virtual, on the same processor.",
        "",
    ]
    peer = rows[-1]
    if "periods" in peer:
        lines += [
            f"heyoka runs in {peer['devices']} processes, over a sample of {peer['cycles']} cycles"
            f" spread over the range; each transient ends when three maxima in a row agree: after"
            f" {peer['periods']['median']:.0f} periods (median), {peer['periods']['most']:.0f} at"
            f" most. It agrees with the package's {result['fine']} segments to"
            f" {peer['error']['worst']:.0e}, so neither is only its own witness.",
            "",
        ]
    else:
        lines += ["Not installed: heyoka.", ""]
    together = result["lanes"]["busy"]
    lines += [
        "By the number of cycles in one call, on one device:",
        "",
        *table(
            ["cycles", "compile [s]", "time a cycle [ms]", "cycles a second"],
            [
                [
                    str(found["cycles"]),
                    f"{found['compile_s']:.1f}",
                    f"{found['seconds_a_cycle'] * 1e3:.3g}",
                    f"{rate(found):.0f}",
                ]
                for found in result["batches"]
            ],
        ),
        "",
        "A loop under `jax.vmap` ends when its slowest member does. The coarse runs take"
        f" {result['lanes']['turns']['mean']:.1f} turns in the mean and"
        f" {result['lanes']['turns']['most']:.0f} at most, so that lanes would be busy for "
        + " and ".join(
            f"{share:.0%} of the time with {n} together" for n, share in together.items()
        )
        + " (mean over longest run within a group, in the order of K_n): a measure of the cycles,"
        " not of a device. On a CPU no more than"
        f" {transient._TOGETHER} run together.",
        "",
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> bytes:
    """Cycles a second by the size of a batch, and of the methods at full size."""
    figure, ax = subplots(figsize=(8.4, 5.4))
    found = result["batches"]
    counts = [row["cycles"] for row in found]
    rates = [rate(row) for row in found]
    ax.plot(counts, rates, "o-", c="tab:blue", mec="k", label="fj.limit_cycle, one device")
    styles = (("s", "tab:cyan"), ("^", "tab:orange"), ("D", "tab:green"), ("v", "tab:red"))
    for row, (marker, colour) in zip(result["methods"][1:], styles, strict=False):
        unit = "cores" if "periods" in row else "devices" if row["devices"] > 1 else "device"
        label = f"{row['name']}, {row['devices']} {unit}"
        cycles = result["methods"][0]["cycles"]
        ax.plot(cycles, rate(row), marker, c=colour, mec="k", ms=9, ls="", label=label)
    ax.set(xscale="log", yscale="log", xlabel="cycles in one call [-]", ylabel="cycles a second")
    ax.grid(True, which="major", alpha=0.4)
    ax.legend(loc="best", fontsize="small")
    return png(figure, dpi=110)
