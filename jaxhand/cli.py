"""The verbs that need the extra `train`. Each takes its arguments and gives an exit code."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

Config = TypeVar("Config")


def train(arguments: list[str]) -> int:
    """`jaxhand train`."""
    from jaxhand import training

    description = (
        "Trains the marker network and the joint network and writes one model file.\n\n"
        "Example: jaxhand train --data manipnet:data/manipnet --out runs/manipnet"
    )
    config = _parsed(training.TrainingConfig, arguments, "jaxhand train", description)
    try:
        training.train(config)
    except (ValueError, OSError) as error:
        print(f"jaxhand train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "jaxhand train: interrupted, and no model was written; --resume goes on from the last "
            "epoch, if there was one",
            file=sys.stderr,
        )
        return 130
    return 0


def evaluate(arguments: list[str]) -> int:
    """`jaxhand evaluate`."""
    from jaxhand import report

    description = (
        "Measures a model beside the baselines: the error of hidden markers by the protocol of the "
        "paper's Table 3, and the joints with nothing hidden.\n\n"
        "Example: jaxhand evaluate --model runs/manipnet/model.npz --data manipnet:data/manipnet"
    )
    config = _parsed(report.EvaluationConfig, arguments, "jaxhand evaluate", description)
    return _told("evaluate", lambda: report.evaluate(config))


def demo(arguments: list[str]) -> int:
    """`jaxhand demo`."""
    from jaxhand import demo

    description = (
        "The whole line on simulated hands, in a few minutes and with no data: trains both "
        "networks, measures them, exports the model and runs it with numpy alone.\n\n"
        "Example: jaxhand demo --out demo"
    )
    config = _parsed(demo.DemoConfig, arguments, "jaxhand demo", description)
    return _told("demo", lambda: demo.demo(config))


def calibrate(arguments: list[str]) -> int:
    """`jaxhand calibrate`."""
    from jaxhand import glove

    description = (
        "Finds out how large the hand in the glove is, from 5 to 30 s in which every finger is "
        "bent and stretched. The tracker then makes joints and wrist on that hand's own bones.\n\n"
        "Example: jaxhand calibrate free.trc --model model.npz -o me.json"
    )
    config = _parsed(glove.CalibrateConfig, arguments, "jaxhand calibrate", description)
    return _told("calibrate", lambda: glove.calibrate_person(config))


def hand(arguments: list[str]) -> int:
    """`jaxhand hand`."""
    from jaxhand import glove

    description = (
        "Writes a hand file for a new glove, from some ten seconds of flat and free motion: where "
        "its markers sit, on which bones.\n\n"
        "Example: jaxhand hand free.trc --like glove9 -o my_glove.json"
    )
    config = _parsed(glove.HandConfig, arguments, "jaxhand hand", description)
    return _told("hand", lambda: glove.describe_glove(config))


def occlusions(arguments: list[str]) -> int:
    """`jaxhand occlusions`."""
    from jaxhand import occlusions

    description = (
        "Counts gaps: how many markers of a hand are hidden at once, which, and for how long, one "
        "hand beside two. Training can hide markers in these proportions.\n\n"
        "Example: jaxhand occlusions take.trc --json gaps.json --picture gaps.png\n\n"
        "Example: jaxhand occlusions both.c3d --left-prefix L_ --right-prefix R_\n\n"
        "Example: jaxhand occlusions simulated"
    )
    config = _parsed(occlusions.OcclusionsConfig, arguments, "jaxhand occlusions", description)
    return _told("occlusions", lambda: occlusions.occlusions(config))


def _parsed(config: type[Config], arguments: list[str], prog: str, description: str) -> Config:
    import tyro

    return tyro.cli(
        config,
        args=arguments,
        prog=prog,
        description=description,
        config=(tyro.conf.FlagCreatePairsOff,),
    )


def _told(verb: str, run: Callable[[], object]) -> int:
    """Runs a verb; what is wrong is one line on stderr and exit code 2."""
    try:
        run()
    except (ValueError, OSError) as error:
        print(f"jaxhand {verb}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"jaxhand {verb}: stopped", file=sys.stderr)
        return 130
    return 0
