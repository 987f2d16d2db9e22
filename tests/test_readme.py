"""The README is true: its Python runs, its commands parse, its files exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

import tyro

from jaxhand import cli, evaluation, predictors
from jaxhand.demo import DemoConfig
from jaxhand.glove import CalibrateConfig, HandConfig
from jaxhand.occlusions import OcclusionsConfig
from jaxhand.report import EvaluationConfig
from jaxhand.training import TrainingConfig
from numpy_infer import Model, load_hand
from numpy_infer.cli import parser
from numpy_infer.model import save
from numpy_infer.predictors import PREDICTORS

REPOSITORY = Path(__file__).resolve().parents[1]
README = (REPOSITORY / "README.md").read_text("utf-8")
CONFIGS = {
    "train": TrainingConfig,
    "evaluate": EvaluationConfig,
    "calibrate": CalibrateConfig,
    "hand": HandConfig,
    "occlusions": OcclusionsConfig,
    "demo": DemoConfig,
}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[list[str]]:
    """Arguments of every `jaxhand` call in the shell blocks."""
    found = []
    for block in blocks("sh"):
        for line in block.splitlines():
            for part in line.split("&&"):
                words = shlex.split(part, comments=True)
                if words[:1] == ["jaxhand"]:
                    found.append(words[1 : words.index(">") if ">" in words else None])
    return found


def test_the_python_blocks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    hand = load_hand("glove9")
    save(Model(hand), tmp_path / "model.npz")
    hidden = hand.template.copy()
    hidden[3] = np.nan
    recordings = np.float32(np.stack([[hand.template, hidden], [hidden, hand.template]]))
    space = {"stream": [(hand.template, 1 / 60), (hidden, 1 / 60)], "recordings": recordings}
    try:
        for block in blocks("python"):
            exec(compile(block, "README.md", "exec"), space)
        suite = [name for name in space if name.startswith("test_")]
        assert suite
        for name in suite:
            space[name]()  # type: ignore[operator]
        assert "template" in evaluation.methods(Model(hand)), "a row of its own"
    finally:
        for name in ("mine", "template"):
            PREDICTORS.pop(name, None)
            predictors.PREDICTORS.pop(name, None)
    assert np.isfinite(space["pose"].markers).all()  # type: ignore[attr-defined]
    assert np.isfinite(space["angles"]).all()  # type: ignore[arg-type]
    assert blocks("python")


@pytest.mark.parametrize("arguments", commands(), ids=" ".join)
def test_every_command_is_one(arguments: list[str]) -> None:
    if arguments[0] in CONFIGS:
        tyro.cli(CONFIGS[arguments[0]], args=arguments[1:])
    else:
        parser().parse_args(arguments)


@pytest.mark.parametrize("verb", CONFIGS)
def test_every_example_of_a_verbs_help_is_a_command_on_a_line_of_its_own(
    verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        getattr(cli, verb)(["--help"])
    examples = re.findall(r"^Examples?: jaxhand (.*)$", capsys.readouterr().out, re.MULTILINE)
    assert examples
    for example in examples:
        name, *arguments = shlex.split(example)
        assert name == verb
        assert "jaxhand" not in arguments
        tyro.cli(CONFIGS[verb], args=arguments)


def test_a_command_that_is_none_would_be_seen() -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(["track", "take.trc", "--modle", "affine", "-o", "out.trc"])
    with pytest.raises(SystemExit):
        tyro.cli(TrainingConfig, args=["--dta", "x"])


def test_every_file_has_its_sentence_and_every_sentence_its_file() -> None:
    named = set(re.findall(r"`(?:(?:numpy_infer|jaxhand|experiments)/)?(\w+\.py)`", README))
    there = {
        path.name
        for folder in ("numpy_infer", "jaxhand", "experiments")
        for path in (REPOSITORY / folder).glob("*.py")
    } - {"__init__.py"}
    helpers = {"options.py", "cli.py"}  # one line each, and `cli` stands twice
    assert there - helpers <= named
    assert named <= there


def test_the_picture_exists() -> None:
    for name in re.findall(r"!\[.*?\]\((.*?)\)", README):
        assert (REPOSITORY / name).is_file()
