"""The verbs that need the extra `train`. Each takes its arguments and gives an exit code."""

from __future__ import annotations

import sys


def train(arguments: list[str]) -> int:
    """`jaxhand train`."""
    import tyro

    from jaxhand import training

    description = (
        "Trains the marker network and the joint network and writes one model file.\n\n"
        "Example: jaxhand train --data manipnet:data/manipnet --out runs/manipnet"
    )
    config = tyro.cli(
        training.TrainingConfig, args=arguments, prog="jaxhand train", description=description
    )
    try:
        training.train(config)
    except ValueError as error:
        print(f"jaxhand train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("jaxhand train: interrupted, and no model was written", file=sys.stderr)
        return 130
    return 0


def evaluate(arguments: list[str]) -> int:
    """`jaxhand evaluate`."""
    import tyro

    from jaxhand import report

    description = (
        "Measures a model beside the baselines: the error of hidden markers by the protocol of the "
        "paper's Table 3, and the joints with nothing hidden.\n\n"
        "Example: jaxhand evaluate --model runs/manipnet/model.npz --data manipnet:data/manipnet"
    )
    config = tyro.cli(
        report.EvaluationConfig, args=arguments, prog="jaxhand evaluate", description=description
    )
    try:
        report.evaluate(config)
    except ValueError as error:
        print(f"jaxhand evaluate: {error}", file=sys.stderr)
        return 2
    return 0


def demo(arguments: list[str]) -> int:
    """`jaxhand demo`."""
    import tyro

    from jaxhand import demo

    description = (
        "The whole line on simulated hands, in a few minutes and with no data: trains both "
        "networks, measures them, exports the model and runs it with numpy alone.\n\n"
        "Example: jaxhand demo --out demo"
    )
    config = tyro.cli(demo.DemoConfig, args=arguments, prog="jaxhand demo", description=description)
    try:
        demo.demo(config)
    except ValueError as error:
        print(f"jaxhand demo: {error}", file=sys.stderr)
        return 2
    return 0
