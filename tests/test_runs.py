"""A run's folder is used, gone on with or thrown away as its owner says, and only then."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("orbax.checkpoint")

from jaxhand import runs


def plain(**options: Any) -> dict[str, Any]:
    return {"seed": 0, "epochs": 3, "resume": False, "overwrite": False, **options}


def test_a_used_folder_is_refused_unless_told_what_to_do(tmp_path: Path) -> None:
    runs.check(tmp_path / "new", plain())
    runs.create(tmp_path / "new", plain())
    with pytest.raises(ValueError, match=r"--resume .* --overwrite"):
        runs.check(tmp_path / "new", plain())
    runs.check(tmp_path / "new", plain(resume=True, epochs=9))
    with pytest.raises(ValueError, match="trained with seed 0, not 1"):
        runs.check(tmp_path / "new", plain(resume=True, seed=1))
    with pytest.raises(ValueError, match="no run to resume"):
        runs.check(tmp_path, plain(resume=True))
    runs.create(tmp_path / "new", plain(digest="a"))
    runs.check(tmp_path / "new", plain(resume=True, digest="a"))
    with pytest.raises(ValueError, match=r"trained on other files .* pass another --out"):
        runs.check(tmp_path / "new", plain(resume=True, digest="b"))


@pytest.mark.parametrize("text", ["[]", '{"seed": 0', "[" * 100_000, '{"seed": 0, "seed": 0}'])
def test_a_config_that_is_none_is_told_of(text: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(text)
    with pytest.raises(ValueError, match=r"config\.json.*pass another --out"):
        runs.check(tmp_path, plain(resume=True))


def test_only_a_run_that_is_there_is_gone_on_with(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").touch()
    for name, message in (
        ("rnus", r"rnus does not exist, so there is no run to resume: leave out --resume"),
        ("empty", r"empty is empty, so there is no run to resume"),
        ("file", r"out: expected a folder"),
    ):
        with pytest.raises(ValueError, match=message):
            runs.check(tmp_path / name, plain(resume=True))
    for name in ("rnus", "empty"):
        runs.check(tmp_path / name, plain())


def test_overwriting_removes_a_runs_own_files_only(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "metrics.jsonl").write_text("{}\n")
    (tmp_path / "checkpoints" / "marker_network").mkdir(parents=True)
    runs.create(tmp_path, plain(overwrite=True))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["config.json", "thesis.tex"]
