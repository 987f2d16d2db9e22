"""Tracks hands from labelled optical markers, with holes: the numpy runtime."""

from numpy_infer.hand import Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.one_euro import Smoothing
from numpy_infer.pose import HandPose, Notice, Status, TrackingState
from numpy_infer.tracker import HandTracker

__all__ = [
    "Hand",
    "HandPose",
    "HandTracker",
    "Model",
    "Notice",
    "Smoothing",
    "Status",
    "TrackingState",
    "load_hand",
]
