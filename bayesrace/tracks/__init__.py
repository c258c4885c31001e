"""Tracks: centrelines with widths, projection on them, files, built-in and random circuits."""

from bayesrace.tracks.library import (
    DEFAULT_RACE_TRACK,
    DEFAULT_TRAINING_TRACK,
    builtin_tracks,
    is_random_track,
    load_any,
    load_track,
    random_track,
    read_recentred,
    read_smoothed,
    read_track,
    wide_enough,
    write_track,
)
from bayesrace.tracks.track import Crossing, PathProjection, StartLine, Track

__all__ = [
    "DEFAULT_RACE_TRACK",
    "DEFAULT_TRAINING_TRACK",
    "Crossing",
    "PathProjection",
    "StartLine",
    "Track",
    "builtin_tracks",
    "is_random_track",
    "load_any",
    "load_track",
    "random_track",
    "read_recentred",
    "read_smoothed",
    "read_track",
    "wide_enough",
    "write_track",
]
