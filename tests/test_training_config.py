"""Senseless trainings are refused, in one line and before anything is lost."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("tyro")

from small_training import CONFIG, HAND, TRAINING, VALIDATION, make_dataset

from jaxhand import cli, options, training, training_data
from jaxhand.tasks import Frames
from jaxhand.training import TrainingConfig, fit_networks
from numpy_infer.networks import Dense, Dropout


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"batch": 0}, "batch"),
        ({"learning_rate": -1.0}, "learning_rate"),
        ({"occlusions": (0.5, 0.4)}, "occlusions"),
        ({"resume": True, "overwrite": True}, "exclude"),
        ({"data": ("a", "b"), "train": ("x",)}, "one data set"),
        ({"drawn": 0.5}, "mixed and drawn: .* 1 together at most, found 1.0 and 0.5"),
        ({"paper_joints": True}, "paper_joints has its own joint_layers"),
        (
            {"paper_joints": True, "joint_layers": TrainingConfig.joint_layers, "joints": False},
            "paper_joints is how joints are trained",
        ),
        ({"data": ("simulated",), "truth": Path("t")}, "truth is fitted to sig18 alone, found sim"),
        ({"data": ("simulated:takes@2",)}, "simulated has no files: leave out takes"),
    ],
)
def test_senseless_configs_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **wrong)


def test_senseless_frames_are_refused() -> None:
    with pytest.raises(ValueError, match=r"expected markers \[N, 9, 3\], found \[320, 8, 3\]"):
        fit_networks(Frames(TRAINING.markers[:, :8]), VALIDATION, HAND, CONFIG)
    with pytest.raises(ValueError, match="expected 32 or more frames, found 31"):
        fit_networks(Frames(TRAINING.markers[:31]), VALIDATION, HAND, CONFIG)
    holes = np.where(np.arange(320)[:, None, None] == 7, np.nan, TRAINING.markers)
    with pytest.raises(ValueError, match="more than 3 markers measured in every frame, found 0"):
        fit_networks(Frames(holes), VALIDATION, HAND, CONFIG)


@pytest.mark.parametrize(
    ("wrong", "message"), [({"batch": 400}, "400 or more frames"), ({"occlusions": "x"}, "no file")]
)
def test_what_is_refused_leaves_the_folder_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, wrong: dict[str, Any], message: str
) -> None:
    given = make_dataset("a", TRAINING, 1.0, 1.1)
    monkeypatch.setattr(training_data, "load", lambda spec, split, **_: given)
    config = replace(CONFIG, data=("a",), out=tmp_path / "run", **wrong)
    with pytest.raises(ValueError, match=message):
        training.train(config)
    assert not config.out.exists()
    config.out.mkdir()
    (config.out / "model.npz").write_text("an older run's")
    with pytest.raises(ValueError, match=message):
        training.train(replace(config, overwrite=True))
    assert [path.name for path in config.out.iterdir()] == ["model.npz"]


def test_layers_are_read_from_text_and_file(tmp_path: Path) -> None:
    assert options.read_layers("200,0.1,150") == (Dense(200), Dropout(0.1), Dense(150))
    file = tmp_path / "layers.json"
    file.write_text('[{"type": "dense", "units": 8, "activation": "linear"}]')
    assert options.read_layers(str(file)) == (Dense(8, "linear"),)
    file.write_text("[{")
    (tmp_path / "object.json").write_text("{}")
    files = [str(tmp_path / name) for name in ("layers.json", "none.json", "object.json")]
    for wrong in ("200,x", "0", "1.5", "", "-3", *files):
        with pytest.raises(ValueError, match="layer"):
            options.read_layers(wrong)


def test_the_command_line_says_what_is_wrong_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.train(["--data", "nonsense", "--out", str(tmp_path)]) == 2
    assert "jaxhand train: no data set 'nonsense'" in capsys.readouterr().err
