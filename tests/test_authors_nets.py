"""The authors' networks: byte for byte there and back, and nothing believed that a file states."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from numpy_infer.formats.authors_nets import ACTIVATIONS, BinLayer, read_bin, write_bin


@st.composite
def a_layer(draw: st.DrawFn) -> BinLayer:
    kind = draw(st.sampled_from(["dense", "simple_rnn", "lstm"]))
    inputs, units = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    width = 4 * units if kind == "lstm" else units
    shapes = [(inputs, width), (width,)]
    if kind != "dense":
        shapes.insert(1, (units, width))
    values = st.floats(width=32)  # NaN and infinities too: the file keeps whatever it holds
    tensors = tuple(draw(hnp.arrays(np.float32, shape, elements=values)) for shape in shapes)
    return BinLayer(kind, draw(st.sampled_from(ACTIVATIONS)), tensors)


LAYERS = st.lists(a_layer(), min_size=1, max_size=3)


@given(layers=LAYERS)
def test_a_network_reads_back_bit_for_bit(
    layers: list[BinLayer], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("bin") / "net.bin"
    write_bin(layers, path)
    got = read_bin(path)
    assert [(one.kind, one.activation) for one in got] == [
        (one.kind, one.activation) for one in layers
    ]
    for one, other in zip(got, layers, strict=True):
        for tensor, expected in zip(one.tensors, other.tensors, strict=True):
            assert tensor.tobytes() == expected.tobytes()
            assert tensor.shape == expected.shape


@given(layers=LAYERS, data=st.data())
def test_a_network_cut_or_lengthened_anywhere_is_refused(
    layers: list[BinLayer], data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("bin") / "net.bin"
    write_bin(layers, path)
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    with pytest.raises(ValueError, match=r"net\.bin: byte \d+: "):
        read_bin(path)
    path.write_bytes(whole + b"\0")
    with pytest.raises(ValueError, match="1 bytes follow the last layer"):
        read_bin(path)


@pytest.mark.parametrize(
    "counts", [[2**31 - 1], [-1], [1, 7, 0], [1, 0, 9], [1, 0, 1, 2**30, 2**30]]
)
def test_a_network_with_absurd_counts_takes_no_memory(counts: list[int], tmp_path: Path) -> None:
    path = tmp_path / "net.bin"
    path.write_bytes(np.array(counts + [1] * 8, "<i4").tobytes())
    with pytest.raises(ValueError, match=r"net\.bin: byte \d+: .*expected"):
        read_bin(path)


def test_layers_refuse_tensors_that_do_not_fit() -> None:
    kernel, bias = np.zeros((2, 3), np.float32), np.zeros(3, np.float32)
    for kind, activation, tensors, message in [
        ("conv", "relu", (kernel, bias), "expected a kind"),
        ("dense", "softmax", (kernel, bias), "expected a kind"),
        ("dense", "relu", (kernel,), "expected ranks"),
        ("dense", "relu", (kernel, bias[:2]), "shapes do not fit"),
        ("lstm", "tanh", (kernel, kernel, bias), "shapes do not fit"),
        ("dense", "relu", (kernel.astype(float), bias), "expected float32"),
    ]:
        with pytest.raises(ValueError, match=message):
            BinLayer(kind, activation, tensors)


@pytest.mark.parametrize(
    ("name", "widths"),
    [("joint_model", (27, 200, 200, 200, 26)), ("marker_model", (27, 200, 150, 200, 27))],
)
def test_real_networks(name: str, widths: tuple[int, ...], data_root: Path, tmp_path: Path) -> None:
    path = data_root / "reference" / f"{name}.bin"
    layers = read_bin(path)
    kernels = [layer.tensors[0].shape for layer in layers]
    assert kernels == list(pairwise(widths))
    assert [layer.activation for layer in layers] == ["relu"] * 3 + ["linear"]
    write_bin(layers, tmp_path / "copy.bin")
    assert (tmp_path / "copy.bin").read_bytes() == path.read_bytes()
