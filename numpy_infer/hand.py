"""A hand as data: markers, skeleton and degrees of freedom. Types and file format live only here.

The hand frame is that of OpenXR's wrist: −z towards the fingers, +y out of the back of the hand,
+x to the right; the left hand is canonical. The origin is the wrist joint. Lengths in metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.formats.json_text import read_json
from numpy_infer.formats.refusal import refusal

FINGERS = ("thumb", "index", "middle", "ring", "pinky")

JOINTS = (
    "wrist",
    *("thumb_cmc", "thumb_mcp", "thumb_ip"),
    *("index_mcp", "index_pip", "index_dip"),
    *("middle_mcp", "middle_pip", "middle_dip"),
    *("ring_mcp", "ring_pip", "ring_dip"),
    *("pinky_mcp", "pinky_pip", "pinky_dip"),
)
"""The 16 joints: carpometacarpal, metacarpophalangeal, proximal and distal interphalangeal."""

TIPS = tuple(f"{finger}_tip" for finger in FINGERS)
POINTS = JOINTS + TIPS
"""The 21 points of the skeleton: 16 joints, then 5 tips."""

CHAINS = tuple((1 + 3 * i, 2 + 3 * i, 3 + 3 * i, 16 + i) for i in range(5))
"""For each finger the indices into `POINTS` of its base, two further joints and tip."""

PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14, 3, 6, 9, 12, 15)
"""Parent of each point in `POINTS`; −1 for the wrist."""

THUMB_AXES = (
    (0.3103977846645418, 0.6186702625243407, -0.7217342457881628),
    (-0.823965028382238, 0.5537257250903663, 0.12028904096469381),
    (0.47406207112402743, 0.5573463264804135, 0.6816378987999316),
)
"""`hand_from_thumb` of the flat hand. Columns: x out of the thumb's radial side, y out of its nail,
z from tip to base; what the hand's own axes are to the fingers."""


class Angle(NamedTuple):
    """One of the 26 joint angles. A joint's angles compose left to right in table order:
    `parent_from_joint = R(axis, angle) R(axis, angle) …`, acting on columns."""

    name: str
    joint: str
    axis: str
    """`x`, `y` or `z` of the joint's own axes in the flat hand (thumb: `THUMB_AXES`)."""
    sign: int
    """−1 where a positive angle turns against the right-hand rule about `axis`."""
    range_deg: tuple[float, float]
    """Anatomical range, degrees."""


def _finger_angles(finger: str) -> tuple[Angle, ...]:
    return (
        Angle(f"{finger}_mcp_flexion", f"{finger}_mcp", "x", -1, (-35, 100)),
        Angle(f"{finger}_mcp_abduction", f"{finger}_mcp", "y", -1, (-30, 30)),
        Angle(f"{finger}_mcp_twist", f"{finger}_mcp", "z", 1, (-20, 20)),
        Angle(f"{finger}_pip_flexion", f"{finger}_pip", "x", -1, (-10, 120)),
        Angle(f"{finger}_dip_flexion", f"{finger}_dip", "x", -1, (-15, 90)),
    )


ANGLES = (
    Angle("thumb_cmc_flexion", "thumb_cmc", "x", -1, (-40, 60)),
    Angle("thumb_cmc_abduction", "thumb_cmc", "y", -1, (-40, 60)),
    Angle("thumb_cmc_twist", "thumb_cmc", "z", 1, (-50, 50)),
    Angle("thumb_mcp_flexion", "thumb_mcp", "x", -1, (-30, 80)),
    Angle("thumb_mcp_abduction", "thumb_mcp", "y", -1, (-25, 25)),
    Angle("thumb_ip_flexion", "thumb_ip", "x", -1, (-40, 90)),
    *(angle for finger in FINGERS[1:] for angle in _finger_angles(finger)),
)
"""The 26 joint angles of the canonical left hand: flexion positive towards the palm, abduction
positive towards the thumb (the thumb's own: palmar, away from the index). Ranges are chosen by eye
about clinical norms of active motion (AAOS, *Joint Motion*, 1965, flexion: MCP 90°, PIP 100°, DIP
90°, thumb MCP 50° and IP 80°), most of them widened to take in passive reach; the MCP joints'
extension is less than the 45° there."""
LOW, HIGH = np.radians([angle.range_deg for angle in ANGLES]).T
"""`[26]` radians each: those ranges."""
ANGLES_OF_FINGER = [[i for i, a in enumerate(ANGLES) if a.joint.startswith(f)] for f in FINGERS]
"""The indices of each finger's angles."""
FINGER_OF_ANGLE = np.repeat(np.arange(len(FINGERS)), [len(own) for own in ANGLES_OF_FINGER])
"""`[26]` the index in `FINGERS` of the finger that each angle moves."""
SLOT_OF_ANGLE = np.concatenate([np.arange(len(own)) for own in ANGLES_OF_FINGER])
"""`[26]` its number among that finger's."""
ANGLE_AT = np.full((len(FINGERS), SLOT_OF_ANGLE.max() + 1), len(ANGLES))
"""`[5, 6]` the angle at each finger's slot; 26 stands for a slot that the finger does not use."""
ANGLE_AT[FINGER_OF_ANGLE, SLOT_OF_ANGLE] = np.arange(len(ANGLES))
FINGER_OF_POINT = np.array([-1, *(i // 3 for i in range(15)), *range(5)])
"""`[21]` the finger of each point; −1 for the wrist."""

OPENXR = {
    "wrist": "XR_HAND_JOINT_WRIST_EXT",
    "thumb_cmc": "XR_HAND_JOINT_THUMB_METACARPAL_EXT",
    "thumb_mcp": "XR_HAND_JOINT_THUMB_PROXIMAL_EXT",
    "thumb_ip": "XR_HAND_JOINT_THUMB_DISTAL_EXT",
    "thumb_tip": "XR_HAND_JOINT_THUMB_TIP_EXT",
    **{
        f"{finger}_{ours}": f"XR_HAND_JOINT_{openxr}_{theirs}_EXT"
        for finger, openxr in zip(FINGERS[1:], ("INDEX", "MIDDLE", "RING", "LITTLE"), strict=True)
        for ours, theirs in (
            ("mcp", "PROXIMAL"),
            ("pip", "INTERMEDIATE"),
            ("dip", "DISTAL"),
            ("tip", "TIP"),
        )
    },
}
"""Our points → the joints of XR_EXT_hand_tracking that stand at the same place. OpenXR's palm and
its four finger metacarpals (at the carpus) have no counterpart here."""

OPENXR_ORDER = (
    "XR_HAND_JOINT_PALM_EXT",
    "XR_HAND_JOINT_WRIST_EXT",
    *(f"XR_HAND_JOINT_THUMB_{part}_EXT" for part in ("METACARPAL", "PROXIMAL", "DISTAL", "TIP")),
    *(
        f"XR_HAND_JOINT_{finger}_{part}_EXT"
        for finger in ("INDEX", "MIDDLE", "RING", "LITTLE")
        for part in ("METACARPAL", "PROXIMAL", "INTERMEDIATE", "DISTAL", "TIP")
    ),
)
"""OpenXR's joints in the order of `XrHandJointEXT`: position in this tuple is the enum's value."""


def openxr_axes(point: str) -> Array:
    """`[3, 3]` rotation `joint_from_openxr`: post-multiply a joint's rotation by it to get OpenXR's
    axes (−z along the bone towards the tip, +y dorsal). Identity except for the thumb."""
    return np.array(THUMB_AXES) if point.startswith("thumb") else np.eye(3)


@dataclass(frozen=True, eq=False)
class Hand:
    """Markers on a skeleton. Has no side: unequal gloves are two hands.

    A marker stands at `joint position + link rotation @ offset`; the link is the joint that carries
    it, which for a marker on a knuckle is the wrist while its joint is the knuckle.
    """

    name: str
    markers: tuple[str, ...]
    joints: tuple[int, ...]
    """`[M]` index into `POINTS` of the point that each marker is placed from."""
    links: tuple[int, ...]
    """`[M]` index into `JOINTS` of the joint whose rotation carries each marker."""
    alignment: tuple[int, ...]
    """Indices of the markers that give the hand's pose."""
    offsets: Array
    """`[M, 3]` metres, marker from its joint, in the link's frame."""
    skeleton: Array
    """`[21, 3]` metres, each point from its parent in the flat hand."""
    template: Array
    """`[M, 3]` metres, hand frame: the markers that registration aligns to."""
    sources: tuple[str, ...] = field(default=())

    def __len__(self) -> int:
        return len(self.markers)

    @cached_property
    def alignment_weight(self) -> Array:
        """`[M]` 1 for alignment markers, else 0."""
        weight = np.zeros(len(self), np.float32)
        weight[list(self.alignment)] = 1
        return weight

    @cached_property
    def aligned(self) -> Array:
        """The indices `alignment`, as an array."""
        return np.array(self.alignment)

    @cached_property
    def finger_markers(self) -> tuple[tuple[int, ...], ...]:
        """For each finger of `FINGERS` the indices of the markers it carries, from its base out."""
        carried: tuple[list[int], ...] = tuple([] for _ in FINGERS)
        for marker, link in enumerate(self.links):
            if link > 0:
                carried[(link - 1) // 3].append(marker)
        return tuple(
            tuple(sorted(own, key=lambda i: (self.links[i], self.joints[i]))) for own in carried
        )

    @cached_property
    def end_markers(self) -> tuple[Array, Array]:
        """`[5]` each: the outermost marker of each finger, and 1 where it has one, else 0."""
        ends = np.array([own[-1] if own else -1 for own in self.finger_markers])
        return ends, (ends >= 0).astype(np.float32)

    @cached_property
    def placing(self) -> tuple[Array, Array]:
        """`[M]` each: `joints` and `links` as arrays."""
        return np.array(self.joints), np.array(self.links)

    @cached_property
    def extent(self) -> float:
        """Metres: at least the largest singular value of any of the template's points, centred."""
        return float(np.linalg.norm(self.template - self.template.mean(0)))

    @cached_property
    def size(self) -> float:
        """Metres: all bones together."""
        return float(np.linalg.norm(self.skeleton, axis=-1).sum())

    @property
    def bone_lengths(self) -> dict[str, float]:
        """Metres from each point's parent to it, without the wrist."""
        return {
            point: float(np.linalg.norm(self.skeleton[i])) for i, point in enumerate(POINTS) if i
        }

    def with_skeleton(self, skeleton: Array) -> Hand:
        """The same markers on other bones `[21, 3]` (metres, flat hand); the template follows."""
        skeleton = np.asarray(skeleton, np.float64)
        if skeleton.shape != (len(POINTS), 3):
            raise ValueError(f"expected a skeleton [21, 3], found {list(skeleton.shape)}")
        _check_finite(self.name, {p: skeleton[i] for i, p in enumerate(POINTS)})
        template = flat_points(skeleton)[list(self.joints)] + self.offsets
        return replace(self, skeleton=skeleton, template=template)

    def resized(self, factor: float) -> Hand:
        """The same hand `factor` times as large, markers included."""
        larger = replace(self, offsets=factor * self.offsets)
        return larger.with_skeleton(factor * self.skeleton)

    def to_json(self) -> dict[str, Any]:
        """Plain data that `hand_from_json` reads back to the same hand, bit for bit."""
        return {
            "format": "jaxhand-hand",
            "version": 1,
            "name": self.name,
            "sources": list(self.sources),
            "alignment": [self.markers[i] for i in self.alignment],
            "markers": [
                {
                    "name": name,
                    "joint": POINTS[joint],
                    "link": JOINTS[link],
                    "offset": offset.tolist(),
                }
                for name, joint, link, offset in zip(
                    self.markers, self.joints, self.links, self.offsets, strict=True
                )
            ],
            "skeleton": {point: self.skeleton[i].tolist() for i, point in enumerate(POINTS)},
            "template": self.template.tolist(),
        }


def flat_points(skeleton: Array) -> Array:
    """`[21, 3]` offsets from parents → `[21, 3]` points of the flat hand, hand frame, metres."""
    points = np.zeros((len(POINTS), 3))
    for i, parent in enumerate(PARENTS):
        points[i] = skeleton[i] + (points[parent] if i else 0)
    return points


def bundled() -> tuple[str, ...]:
    """Names of the hands that come with the package."""
    folder = resources.files("numpy_infer") / "hands"
    return tuple(sorted(f.name[:-5] for f in folder.iterdir() if f.name.endswith(".json")))


def load_hand(name_or_path: str | Path) -> Hand:
    """A bundled hand by name (`glove9`), or a hand file by path.

    Raises:
        ValueError: no such hand; or the file is refused, with the name of the culprit.
    """
    name = str(name_or_path)
    if name in bundled():
        file = resources.files("numpy_infer") / "hands" / f"{name}.json"
    elif Path(name).is_file():
        file = Path(name)
    else:
        raise ValueError(f"no hand {name!r}: expected a hand file or one of {', '.join(bundled())}")
    try:
        return hand_from_json(read_json(file))
    except ValueError as error:  # no JSON, no hand
        raise refusal(name, error) from None


def hand_from_json(data: Any) -> Hand:
    """Reads what a hand file holds; every check of a hand stands here.

    Raises:
        ValueError: an unknown key or joint, a duplicate marker, fewer than 3 or collinear alignment
            markers, a number that is not finite; the message names the culprit.
    """
    known = {"format", "version", "name", "sources", "alignment", "markers", "skeleton", "template"}
    _check_mapping("a hand", data, required=known - {"sources", "template"}, known=known)
    if data["format"] != "jaxhand-hand" or data["version"] != 1:
        raise ValueError(
            f"expected format 'jaxhand-hand' version 1, found {data['format']!r} "
            f"version {data['version']!r}"
        )
    sources = data.get("sources", [])
    if not isinstance(sources, list) or not all(isinstance(source, str) for source in sources):
        raise ValueError(f"'sources' must be a list of strings, found {sources!r}")
    if not isinstance(data["name"], str):
        raise ValueError(f"'name' must be a string, found {data['name']!r}")
    skeleton = _read_skeleton(data["skeleton"])
    if not isinstance(data["markers"], list):
        raise ValueError("'markers' must be a list of objects")
    names, joints, links, offsets = [], [], [], []
    for marker in data["markers"]:
        _check_mapping(
            "a marker",
            marker,
            required={"name", "joint", "offset"},
            known={"name", "joint", "offset", "link"},
        )
        name, joint = marker["name"], marker["joint"]
        if not isinstance(name, str):
            raise ValueError(f"a marker's name must be a string, found {name!r}")
        if name in names:
            raise ValueError(f"marker {name!r} stands twice")
        if joint not in POINTS:
            raise ValueError(f"marker {name!r}: unknown joint {joint!r}, expected one of {POINTS}")
        # A tip has no rotation of its own: it is carried by the joint before it.
        carrier = joint if joint in JOINTS else JOINTS[PARENTS[POINTS.index(joint)]]
        link = marker.get("link", carrier)
        if link not in JOINTS:
            raise ValueError(f"marker {name!r}: unknown link {link!r}, expected one of {JOINTS}")
        chain = {JOINTS.index(link), POINTS.index(joint)}
        if link != "wrist" and not any(chain <= set(finger) for finger in CHAINS):
            raise ValueError(
                f"marker {name!r}: {joint!r} is not on the finger of its link {link!r}"
            )
        names.append(name)
        joints.append(POINTS.index(joint))
        links.append(JOINTS.index(link))
        offsets.append(_numbers(f"offset of marker {name!r}", marker["offset"]))
    if not isinstance(data["alignment"], list):
        raise ValueError("'alignment' must be a list of marker names")
    for name in data["alignment"]:
        if name not in names:
            raise ValueError(f"alignment marker {name!r} is not among the markers")
    if len(set(data["alignment"])) < max(3, len(data["alignment"])):
        raise ValueError(f"expected 3 or more different alignment markers: {data['alignment']}")
    alignment = tuple(names.index(name) for name in data["alignment"])
    template = flat_points(skeleton)[joints] + np.array(offsets)
    if "template" in data:
        if not isinstance(data["template"], list) or len(data["template"]) != len(names):
            raise ValueError(f"expected a template of {len(names)} points")
        template = np.array(
            [
                _numbers(f"template of {n!r}", p)
                for n, p in zip(names, data["template"], strict=True)
            ]
        )
    aligned = template[list(alignment)]
    if np.linalg.svd(aligned - aligned.mean(0), compute_uv=False)[1] < 5e-3:
        raise ValueError(f"alignment markers {data['alignment']} are collinear")
    return Hand(
        name=data["name"],
        markers=tuple(names),
        joints=tuple(joints),
        links=tuple(links),
        alignment=alignment,
        offsets=np.array(offsets),
        skeleton=skeleton,
        template=template,
        sources=tuple(sources),
    )


def _read_skeleton(data: Any) -> Array:
    if isinstance(data, str):
        file = resources.files("numpy_infer") / "hands" / "skeletons" / f"{data}.json"
        if not data.isidentifier() or not file.is_file():
            raise ValueError(
                f"no bundled skeleton {data!r}: expected 'adult' or an object of points"
            )
        data = read_json(file)["points"]
    _check_mapping("a skeleton", data, required=set(POINTS), known=set(POINTS))
    return np.array([_numbers(f"joint {point!r}", data[point]) for point in POINTS])


def _check_mapping(what: str, data: Any, required: set[str], known: set[str]) -> None:
    if not isinstance(data, dict):
        raise ValueError(f"expected {what} as a JSON object, found {type(data).__name__}")
    for key in sorted(required - set(data)):
        raise ValueError(f"{what} lacks {key!r}")
    for key in sorted(set(data) - known):
        raise ValueError(f"{what} has an unknown entry {key!r}")


def _numbers(what: str, values: Any) -> Array:
    numbers = isinstance(values, list) and all(type(value) in (int, float) for value in values)
    if not numbers or len(values) != 3:
        raise ValueError(f"{what}: expected 3 numbers, found {values!r}")
    # Compared as Python numbers: an integer may be too large for a float.
    if any(abs(value) > 10 for value in values if abs(value) != float("inf")):
        raise ValueError(f"{what}: expected metres, found {values!r}")
    array = np.array(values, np.float64)
    _check_finite(what, {what: array})
    return array


def _check_finite(what: str, arrays: Mapping[str, Array]) -> None:
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise ValueError(f"{what}: {name} is not finite: {array.tolist()}")
