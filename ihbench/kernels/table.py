"""Work-precision of the bench's own kernels: milliseconds and error against the slow twin, for every back end.

Behind `ihbench kernels`. A kernel is an entry of `KERNELS`, or one that a method's spec names: a function from the
number of repetitions to table rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from ihbench.clock.machine import BUSY, Machine
from ihbench.document.document import Block, Paragraph, Table
from ihbench.errors import BadInput
from ihbench.kernels.measuring import UNSTABLE, Row
from ihbench.kernels.metrics import flip_rows, frame_rows, lpips_rows, ssim_rows
from ihbench.kernels.position_maps import position_map_rows
from ihbench.kernels.sampler import sampler_rows
from ihbench.kernels.scoring import score_rows
from ihbench.kernels.skinning import lbs_rows
from ihbench.kernels.splats import WINDOW, general_splat_rows, large_splat_rows, splat_rows
from ihbench.kernels.zbuffers import zbuffer_rows
from ihbench.scene.method_spec import usable_specs

REPEATS = 15


def run_kernels(names: Sequence[str] | None = None, repeats: int = REPEATS) -> list[Row]:
    """Measure the kernels called `names` (all but the `LARGE` by default); returns the rows.

    Raises BadInput for an unknown name or fewer than one repetition.
    """
    of_methods = {name: (spec, kernel) for spec in usable_specs() for name, kernel in spec.kernels.items()}
    known = dict.fromkeys([*KERNELS, *of_methods])
    unknown = sorted(set(names or ()) - {*known, *LARGE})
    if unknown:
        raise BadInput(f"kernel {unknown[0]!r}: expected one of {', '.join(sorted({*known, *LARGE}))}")
    if repeats < 1:
        raise BadInput(f"kernel repetitions: expected at least 1, got {repeats}")
    rows: list[Row] = []
    for name in names or known:
        own = KERNELS.get(name) or LARGE.get(name)
        rows += (own or of_methods[name][0].load(of_methods[name][1]))(repeats)
    first: dict[tuple[str, str], float] = {}
    for row in rows:
        first.setdefault((row.kernel, row.case), row.forward_ms)
    return [replace(row, ratio=row.forward_ms / first[row.kernel, row.case]) for row in rows]


# measured only where they are named
LARGE: dict[str, Callable[[int], list[Row]]] = {"splat-large": large_splat_rows}
KERNELS: dict[str, Callable[[int], list[Row]]] = {
    "splat": splat_rows,
    "splat-general": general_splat_rows,
    "zbuffer": zbuffer_rows,
    "ssim": ssim_rows,
    "flip": flip_rows,
    "lpips": lpips_rows,
    "lbs": lbs_rows,
    "position-map": position_map_rows,
    "frame": frame_rows,
    "score": score_rows,
    "sampler": sampler_rows,
}


def blocks_of(here: Machine, rows: Sequence[Row]) -> list[Block]:
    """The rows as a table, the machine, and what the numbers are."""
    cells = []
    for row in rows:
        forward = _spread(row.forward_ms, row.forward_iqr_ms)
        backward = "–" if row.backward_ms is None else _spread(row.backward_ms, row.backward_iqr_ms or 0.0)
        memory = "–" if row.peak_mib is None else f"{row.peak_mib:.0f}"
        processor = "–" if row.processor_ms is None else _digits(row.processor_ms)
        pairs = "–" if row.pairs_per_second is None else f"{row.pairs_per_second / 1e6:.0f}"
        errors = ("–" if error is None else f"{error:.0e}" for error in (row.value_error, row.gradient_error))
        note = "unstable" if row.unstable else ""
        of = row.kernel, row.case, row.backend
        cells.append((*of, forward, f"{row.ratio:.2f}", backward, processor, pairs, memory, *errors, note))
    times = ("fwd ms", "ratio", "bwd ms", "cpu ms", "Mpairs/s")
    head = ("kernel", "case", "back end", *times, "MiB", "error", "grad err", "note")
    gpu = f", {here.gpu}" if here.gpu else ""
    lines = [f"{here.cpu}, {here.torch_threads} threads{gpu}, load average {here.load_average}"]
    if busy(here):
        lines.append(f"Other work is running here (load above {BUSY} per core): these times are unstable.")
    lines.append(
        f"Median ± half the interquartile range; unstable: the range exceeds {UNSTABLE:.0%} of the median; ratio: of"
        " the forward time to that of the case's first row; cpu ms: processor time of forward and backward; Mpairs/s:"
        " pixels under all splats' footprints, in millions, over both times. Errors of splats are against the float64"
        f" twin in a window of {WINDOW}² px (image: largest; gradient: relative norm), those of the z-buffer its"
        " depth's, in m, against numpy, those of metrics against the float64 oracle on a small frame (LPIPS: against"
        " its package in float64), those of skinning and position maps the largest distance in m from float64 numpy,"
        " those of the sampler the rms over hidden pixels from many steps in float64."
    )
    return [Table(head, tuple(cells), left=3), *map(Paragraph, lines)]


def busy(here: Machine) -> bool:
    """Whether the load at the end says that other work was in the way."""
    return bool(here.load_average) and here.load_average[0] > BUSY * (here.cores_usable or 1)


def _spread(median: float, iqr: float) -> str:
    return f"{_digits(median)}±{_digits(iqr / 2)}"


def _digits(ms: float) -> str:
    return f"{ms:.1f}" if ms < 1000 else f"{ms:.0f}"
