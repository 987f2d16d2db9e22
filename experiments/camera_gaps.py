"""Simulated gaps beside measured ones: `python experiments/camera_gaps.py`.

Measured are five markers on each of two hands in a studio, 8.7 million frames whose statistics are
`gaps.json`. Simulated are five fingertips of people who move both hands before `cameras.Rig`, whose
parameters `--search 200` tries to better. The measured frame rate is not known and taken
to be 120 Hz; they rest more than `two_hands`, which is played slower: at full speed only drop-outs
without end would give gaps as long as the measured ones.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxhand.anthropometry import People, people
from jaxhand.cameras import Rig, film
from jaxhand.compiled import compiled
from jaxhand.occlusions import QUANTILES, Occlusions, bins, statistics
from jaxhand.two_hands import two_hands
from numpy_infer.arrays import Array
from numpy_infer.hand import TIPS, Hand, load_hand

RATE, LONGEST = 120.0, 999
"""Frames per second; longer gaps are cut, as in the measured statistics."""

PACE = 0.35
"""Speed of the hands beside that of `two_hands`."""

SEARCHED = {
    "low": (0.3, 0.3, 1.0),
    "high": (0.2, 1.5, 3.5),
    "cone": (0.1, 1.0, 2.2),
    "thickness": (0.1, 0.7, 1.3),
    "fade": (0.4, 0.005, 0.3),
    "blur": (0.4, 0.1e-3, 2e-3),
    "per_second": (0.5, 0.001, 1.0),
    "seconds": (0.4, 1 / RATE, 0.1),
    "tail": (0.2, 0.2, 1.2),
}
"""Parameters of the rig and its drop-outs that are fitted: standard deviation of the logarithm of
what is tried, and bounds of what is credible."""
COUNTS = (8, 10, 12, 14, 16)
"""Numbers of cameras that it tries."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    data = Path(os.environ.get("JAXHAND_DATA", "../shared/data"))
    parser.add_argument("--gaps", type=Path, default=data / "gaps.json", help="measured statistics")
    parser.add_argument("--recordings", type=int, default=16)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--search", type=int, default=0, help="how many rigs to try")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path, help="draw who is seen when, with one and two hands")
    options = parser.parse_args()
    measured = json.loads(options.gaps.read_text("utf-8"))["five_fingers"]
    hand = only(load_hand("glove9"), TIPS)
    person_key, motion_key, key = jax.random.split(jax.random.key(options.seed), 3)
    frames, batch = round(RATE * options.seconds), (options.recordings,)
    person = people(person_key, hand, batch)
    motions = compiled(two_hands, static_argnums=(1, 2, 3))(
        motion_key, frames, RATE / PACE, batch, person
    )

    @partial(compiled, static_argnames="cameras")
    def run(key: Array, person: People, motions: Any, rig: Rig, cameras: int) -> Any:
        return film(key, hand, person, *motions, RATE, rig._replace(cameras=cameras))

    def counted(rig: Rig) -> tuple[Occlusions, Occlusions, Array]:
        made = run(key, person, motions, rig._replace(cameras=0), rig.cameras)
        alone, both = (np.asarray(seen) for seen in made)
        one, two = (
            statistics(hand.markers, RATE, [*np.concatenate(seen)], LONGEST)
            for seen in (alone, both)
        )
        return one, two, np.concatenate([alone, both])

    rig = Rig()
    if options.search:
        rig = search(lambda rig: counted(rig)[1], measured, options.search, options.seed)
    begin = time.perf_counter()
    one, two, seen = counted(rig)
    print(f"{rig}\n{time.perf_counter() - begin:.0f} s with compilation")
    show(one, two, measured)
    if options.plot:
        raster(seen[:, 0], hand, options.plot)


def only(hand: Hand, markers: tuple[str, ...]) -> Hand:
    """The hand with these of its markers alone."""
    own = [hand.markers.index(name) for name in markers]
    return replace(
        hand,
        markers=markers,
        joints=tuple(hand.joints[i] for i in own),
        links=tuple(hand.links[i] for i in own),
        alignment=(),
        offsets=hand.offsets[own],
        template=hand.template[own],
    )


def figures(table: Occlusions) -> dict[str, float]:
    """What the fit is about; frames, and a rate."""
    return {
        "median gap": table.lengths[QUANTILES.index(0.5)],
        "90 % of gaps within": table.lengths[QUANTILES.index(0.9)],
        "half of the missing frames in gaps within": table.weighted[QUANTILES.index(0.5)],
        "missing rate": sum(table.missing) / len(table.missing),
    }


def measured_figures(measured: Mapping[str, Any]) -> dict[str, float]:
    weighted = measured["gap_length_quantiles_weighted_by_missing_frames"]
    return {
        "median gap": measured["gap_length_frames_quantiles"]["0.5"],
        "90 % of gaps within": measured["gap_length_frames_quantiles"]["0.9"],
        "half of the missing frames in gaps within": weighted["0.5"],
        "missing rate": float(np.mean(measured["missing_rate_per_marker"])),
    }


def off(table: Occlusions, measured: Mapping[str, Any]) -> float:
    """How far a table is from the measured one: root mean square of logarithms of figures, and of
    the bins of gap lengths."""
    pairs = zip(figures(table).values(), measured_figures(measured).values(), strict=True)
    far = [math.log(max(a, 1e-6) / b) for a, b in pairs]
    ours, theirs = shares(table), shares(measured)
    far += [0.5 * math.log((a + 1e-3) / (b + 1e-3)) for a, b in zip(ours, theirs, strict=True)]
    return math.sqrt(sum(x * x for x in far) / len(far))


def shares(table: Occlusions | Mapping[str, Any]) -> list[float]:
    """Of all gaps, those of 1, of 2 and 3, … of 512 and more frames."""
    if isinstance(table, Occlusions):
        counts = list(table.histogram) + [0] * (10 - len(table.histogram))
    else:
        counts = list(table["gap_length_histogram_log2"].values())
    return [count / max(sum(counts), 1) for count in counts]


def search(counted: Any, measured: Mapping[str, Any], rigs: int, seed: int) -> Rig:
    """The best of some rigs, each a change of the best so far, all on the same motion."""
    random = np.random.default_rng(seed)
    best = Rig()
    least = off(counted(best), measured)
    for trial in range(rigs):
        rig = best
        for name in random.choice([*SEARCHED, "cameras"], random.integers(1, 4), replace=False):
            rig = changed(rig, name, random)
        found = off(counted(rig), measured)
        if found < least:
            best, least = rig, found
            print(f"{trial}: {least:.3f} {best}", flush=True)
    return best


def changed(rig: Rig, name: str, random: np.random.Generator) -> Rig:
    """The rig with another value of one of its parameters."""
    if name == "cameras":
        return rig._replace(cameras=int(random.choice(COUNTS)))
    spread, least, most = SEARCHED[name]
    of = rig.dropouts if name in rig.dropouts._fields else rig
    value = getattr(of, name) * np.exp(spread * random.standard_normal())
    new = of._replace(**{name: float(np.clip(value, least, most))})
    return new if isinstance(new, Rig) else rig._replace(dropouts=new)


def show(one: Occlusions, two: Occlusions, measured: Mapping[str, Any]) -> None:
    print(f"{'':44}{'measured':>10}{'simulated':>10}{'one hand':>10}")
    columns = measured_figures(measured), figures(two), figures(one)
    for name in columns[0]:
        print(f"{name:44}" + "".join(f"{column[name]:10.4g}" for column in columns))
    shared = shares(measured), shares(two), shares(one)
    for i, name in enumerate(bins(len(shared[0]))):
        print(f"{'gaps of ' + name + ' frames':44}" + "".join(f"{s[i]:10.4f}" for s in shared))
    for number in range(len(one.hidden)):
        print(
            f"{f'{number} hidden at once':44}{'':10}{two.hidden[number]:10.4f}"
            f"{one.hidden[number]:10.4f}"
        )
    for name, both, alone in zip(one.markers, two.missing, one.missing, strict=True):
        print(f"{name + ' missing':44}{'':10}{both:10.4f}{alone:10.4f}")


def raster(seen: Array, hand: Hand, path: Path) -> None:
    """`[4, T, M]` left and right hand alone, then beside each other: dark where missing."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 6), layout="constrained")
    panels = figure.subplots(4, 1, sharex=True)
    titles = "left alone", "right alone", "left beside the right", "right beside the left"
    for panel, title, one in zip(panels, titles, seen, strict=True):
        extent = (0, len(one) / RATE, len(hand) - 0.5, -0.5)
        panel.imshow(one.T, cmap="gray", aspect="auto", interpolation="none", extent=extent)
        panel.set_yticks(range(len(hand)), hand.markers)
        panel.set_title(title, loc="left", fontsize=10)
    panels[-1].set_xlabel("s")
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
