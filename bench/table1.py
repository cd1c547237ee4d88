"""Table I, ours beside the paper's, and experiments that explain the differences; writes docs/results/table1.md."""

from __future__ import annotations

import numpy as np

from bench.common import RESULTS, table, written_by
from stimrig import identify
from stimrig.identify import paper
from stimrig.identify.dynamics.linear import Discrete, SecondOrder
from stimrig.identify.estimation.fit_statistics import best_fit_percent
from stimrig.identify.records.record import Record

TARGET = RESULTS / "table1.md"
TRIALS = 100
FEW = 20
SEED = 30_000


def run() -> None:
    """Measure and write."""
    parts = [
        main_table(),
        scored_rows(),
        where_noise_enters(),
        inverting(),
        sampling_rate(),
        taps(),
        natural_frequency(),
        iterations(),
    ]
    for part in parts:
        print(*part, "", sep="\n", flush=True)
    TARGET.write_text("\n\n".join("\n".join(part) for part in parts) + "\n")


def fits(noise_nm: float, method: str, rate_hz: float = 40.0, trials: int = FEW, **options: object) -> dict[str, float]:
    """Mean scores over trials."""
    count = trials if noise_nm else 1
    scores = [paper.score(*paper.simulate(noise_nm, SEED + t, rate_hz), method, **options) for t in range(count)]
    return {key: float(np.median([s[key] for s in scores])) for key in scores[0]}


def format_score(value: float) -> str:
    return f"{value:.2f}" if value > -100 else "runs away"


def both(scores: dict[str, float]) -> str:
    """Return the scores on the clean ramp and on the unseen input."""
    return f"{format_score(scores['clean'])} / {format_score(scores['unseen'])}"


def main_table() -> list[str]:
    scores = paper.table1(TRIALS)
    lines = [
        "# Table I, ours beside the paper's",
        "",
        written_by("python -m bench table1"),
        f"`stimrig table1 --trials {TRIALS}` prints the same numbers.",
        "",
        "The paper's muscle (section V), 40 pulses and 40 samples a second, white noise on the output. One record:",
        "rest, PRBS (127 levels of 5 pulses, 0 or 300 µs), rest, triangular ramp (5 s up, 5 s down), rest, unseen",
        "multi-level part. Best fit, %. *noisy*: against the noisy ramp; *ceiling*: the true system's own score there;",
        "*clean*: against the ramp without noise; *unseen*: on the multi-level part without noise, never fitted.",
        "",
    ]
    rows = []
    for row in scores["rows"]:
        printed = "–" if row["paper"] is None else f"{row['paper']:.2f} ± {row['paper_sd']:.2f}"
        ours = f"{row['ours']:.2f} ± {row['ours_sd']:.2f}"
        others = [f"{row[name]:.2f}" for name in ("ceiling", "clean", "unseen")]
        rows.append([f"{row['noise_nm']:.2f}", row["method"], printed, ours, *others])
    return [
        *lines,
        *table(["noise", "method", "paper", "ours, noisy", "ceiling", "clean", "unseen"], rows),
        "",
        "What it tells: two-stage and maximum-likelihood score what the true system scores, to a few hundredths (a",
        "fit even gains a little on the noise it was fitted to). The paper's column therefore measures the noise.",
        "What sets methods apart is the clean fit and, far more, the unseen input: ramp deconvolution and separable",
        "least squares with 41 taps look like 90 % on their ramp and are 64 to 76 % elsewhere.",
    ]


def scored_rows() -> list[str]:
    widths, labels = paper.protocol()
    clean, names = paper.torque(widths, 40.0), np.array(labels)
    ramp = np.flatnonzero(names == "ramp")
    place = np.arange(names.size)
    sets = {
        "the ramp (ours)": names == "ramp",
        "the ramp with its rests": (place >= ramp[0] - 200) & (place <= ramp[-1] + 120),
        "the PRBS": names == "prbs",
        "PRBS and ramp with their rests": place <= ramp[-1] + 120,
    }
    record, _ = paper.simulate(0.0, SEED)
    rivals = [
        identify.predict(identify.fit(record, method=method), record)
        for method in ("ramp-deconvolution", "separable-least-squares")
    ]
    levels = paper.NOISE_NM[1:]
    lines = [
        "## Which rows are scored sets the ceiling",
        "",
        "The ceiling is 100 (1 - λ/s), s the standard deviation of the clean torque over the rows that are scored.",
        "The paper doesn't say which rows. Its two-stage column is a straight line of one slope λ/s, as a ceiling is;",
        "the s it stands for is that of PRBS and ramp together. On the right, the two rivals without noise on the",
        "same rows (the paper: 91.24 and 92.06).",
        "",
    ]
    scored = []
    for name, rows in sets.items():
        spread = float(np.std(clean[rows]))
        cells = [f"{100 * (1 - level / spread):.2f}" for level in levels]
        cells += [f"{best_fit_percent(clean[rows], predicted[rows]):.2f}" for predicted in rivals]
        scored.append([name, f"{spread:.2f}", *cells])
    printed = [value for value, _ in paper.PAPER["two-stage"][1:]]
    spread = float(np.mean([level / (1 - value / 100) for level, value in zip(levels, printed, strict=True)]))
    scored.append(["the paper's two-stage column", f"{spread:.2f}", *(f"{value:.2f}" for value in printed)])
    scored[-1] += ["91.24", "92.06"]
    heads = ["scored on", "s, N·m", *(f"λ = {level:g}" for level in levels), "ramp dec.", "SLS"]
    return [*lines, *table(heads, scored)]


def poles_as_constants(block: Discrete) -> tuple[float, float]:
    """Tω and ζ that a second-order block's poles stand for."""
    pole = np.log(block.poles.astype(complex)[0]) / block.step_s
    other = np.log(block.poles.astype(complex)[1]) / block.step_s
    natural = np.sqrt(abs(pole * other))
    return float(1 / natural), float(np.real(-(pole + other)) / (2 * natural))


def literal(noise_nm: float, seed: int, *, through_a: bool) -> tuple[Record, np.ndarray]:
    """As `paper.simulate`, or with the noise of equation (9), passed through 1/A(q)."""
    record, clean = paper.simulate(noise_nm, seed, 40.0)
    if not through_a:
        return record, clean
    from scipy.signal import lfilter

    a = SecondOrder(paper.TIME_CONSTANT_S, paper.DAMPING).discrete(40.0)[1]
    coloured = lfilter([1.0], a, record.torque_nm - clean)
    coloured *= np.std(record.torque_nm - clean) / np.std(coloured) if noise_nm else 1.0
    return record.with_torque(clean + coloured), clean


def where_noise_enters() -> list[str]:
    lines = [
        "## Where the noise enters: equation (25) as printed",
        "",
        "Least squares on the equation error is right when the noise passes through 1/A(q), as (9) writes it, and",
        "wrong when it is added to the torque, as a load cell does and as section V says. Two-stage, (l, n, d) =",
        f"(2, 1, 1), noise of 0.02 N·m at the output either way, median of {FEW} trials. True: 0.528 and 0.637.",
        "",
    ]
    cells = []
    for through_a in (True, False):
        for linear in ("equation-error", "output-error"):
            rows = []
            for trial in range(FEW):
                record, clean = literal(0.02, SEED + trial, through_a=through_a)
                options = {"order": "2,1,1", "linear": linear}
                block = identify.fit(record, method="two-stage", **options).linear
                assert isinstance(block, Discrete)
                scores = paper.score(record, clean, "two-stage", **options)
                rows.append([*poles_as_constants(block), scores["clean"], scores["unseen"]])
            t, z, ramp, unseen = np.median(rows, axis=0)
            place = "through 1/A, as (9)" if through_a else "at the output, as section V"
            cells.append([place, linear, f"{t:.3f}", f"{z:.3f}", format_score(ramp), format_score(unseen)])
    lines += table(["noise", "linear stage", "Tω, s", "ζ", "clean ramp", "unseen"], cells)
    return [*lines, "", "The output-error linear stage is right in both; it is the default."]


def inverting() -> list[str]:
    b = np.array(SecondOrder(paper.TIME_CONSTANT_S, paper.DAMPING).discrete(40.0)[0])
    lines = [
        "## Inverting G: equations (26) to (28) as printed",
        "",
        f"The true zero at 40 Hz is at {-b[1] / b[0]:.3f}: w = G⁻¹y rings at half the sampling rate with hardly any",
        "decay, and G⁻¹ itself multiplies noise by hundreds. Clean ramp / unseen, two-stage with (2, 1, 1), the linear",
        "stage by output error; on the right how often (25) as printed puts a zero outside the unit circle:",
        "",
    ]
    cells = []
    for noise in (0.0, 0.02, 0.10):
        forward, back = (fits(noise, "two-stage", order="2,1,1", inverse=inverse) for inverse in (False, True))
        outside = 0
        count = FEW if noise else 1
        for trial in range(count):
            record, _ = paper.simulate(noise, SEED + trial)
            block = identify.fit(record, method="two-stage", order="2,1,1", linear="equation-error").linear
            assert isinstance(block, Discrete)
            outside += bool(np.any(np.abs(np.roots(block.b)) >= 1))
        cells.append([f"{noise:.2f}", both(forward), both(back), f"{outside} of {count}"])
    heads = "noise, spline through G (default), spline on w = G⁻¹y"
    return lines + table([*heads.split(", "), "unstable inverse, linear stage (25)"], cells)


def sampling_rate() -> list[str]:
    lines = [
        "## Sampling rate",
        "",
        "Figure 4 says 1600 samples a second. A fit against 1600 noisy samples a second has the same ceiling, but",
        "forty times the information: the clean fits rise. Noise 0.10 N·m, clean ramp / unseen:",
        "",
    ]
    rates = (40.0, 400.0, 1600.0)
    cells = [[method, *(both(fits(0.10, method, rate, trials=5)) for rate in rates)] for method in paper.OURS]
    return lines + table(["method", *(f"{rate:g} Hz" for rate in rates)], cells)


def taps() -> list[str]:
    lines = [
        "## Separable least squares: 41 taps are 1 s",
        "",
        "The muscle's memory is about 4 s. Without noise, clean ramp / unseen:",
        "",
    ]
    cells = []
    for count in (41, 81, 121, 161):
        of_both, alone = (
            fits(0.0, "separable-least-squares", taps=count, fit_on=segments) for segments in (None, ("ramp",))
        )
        cells.append([f"{count} ({(count - 1) / 40:g} s)", both(of_both), both(alone)])
    return [
        *lines,
        *table(["taps (memory)", "fitted on PRBS and ramp", "fitted on the ramp alone"], cells),
        "",
        "The paper's 92.06 % lies between the two ways of fitting 41 taps; which rows it used it doesn't say. With",
        "4 s of memory the method nearly reaches the others without noise.",
    ]


def natural_frequency() -> list[str]:
    lines = [
        "## Ramp deconvolution: the assumed dynamics",
        "",
        "Critically damped, 0.85π rad/s, against the muscle's ζ of 0.637. Without noise, clean ramp / unseen:",
        "",
    ]
    cells = []
    for label, frequency in (
        ("0.85π rad/s (the paper's)", 0.85 * np.pi),
        ("0.85 Hz", 2 * np.pi * 0.85),
        ("1/Tω of the muscle", 1 / paper.TIME_CONSTANT_S),
        ("same slow-input lag as the muscle, 1/(ζTω)", 1 / (paper.DAMPING * paper.TIME_CONSTANT_S)),
    ):
        scores = fits(0.0, "ramp-deconvolution", natural_frequency_rad_s=frequency)
        cells.append([label, f"{1 / frequency:.3f}", f"{scores['clean']:.2f}", f"{scores['unseen']:.2f}"])
    return [
        *lines,
        *table(["natural frequency", "Tω, s", "ramp", "unseen"], cells),
        "",
        "A ramp tells little more than the lag 2ζTω: dynamics with about that lag fit it, and fail on steps. Our",
        "deconvolution is regularised (a spline in time), which a bare inverse with two derivatives isn't.",
    ]


def iterations() -> list[str]:
    lines = ["## One iteration or more", "", "Two-stage, noise 0.10 N·m, 40 Hz: clean ramp / unseen.", ""]
    by_label: dict[object, dict[str, float]] = {n: fits(0.10, "two-stage", iterations=n) for n in (0, 1, 2, 4)}
    by_label["maximum-likelihood (joint)"] = fits(0.10, "maximum-likelihood")
    cells = [[label, f"{scores['clean']:.2f}", f"{scores['unseen']:.2f}"] for label, scores in by_label.items()]
    return [
        *lines,
        *table(["iterations", "clean ramp", "unseen"], cells),
        "",
        "The paper's belief that one iteration is enough holds; the joint estimate gains a little more.",
    ]
