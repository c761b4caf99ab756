"""Random places on a sphere with a least distance from each other."""

from math import cos, degrees, pi, radians

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_TRIES, MOST_STARTS = 300, 30  # for one place; with all places anew
DENSEST = pi / 12**0.5  # part of the plane that equal discs can cover


class NoRoom(ValueError):
    """The places do not fit at their least distance; the message has the numbers."""


def random_places(rng: np.random.Generator, count: int, polar: tuple[float, float], distance: float) -> Array:
    """Polar angles and azimuths (count, 2) in degrees, uniform in area between two polar angles.

    A place at less than `distance` from an earlier one is drawn again (random sequential addition).

    Parameters
    ----------
    polar, distance
        In degrees; the distance is the angle between two places, seen from the centre.

    Raises
    ------
    NoRoom
        If not even a dense packing has room, or none was found.
    """
    refuse_no_room(count, polar, distance)
    low, high, least = cos(radians(polar[1])), cos(radians(polar[0])), cos(radians(distance))
    for _ in range(MOST_STARTS):
        found = np.empty((0, 3))
        for _ in range(count):
            for _ in range(MOST_TRIES):
                z, azimuth = rng.uniform(low, high), rng.uniform(0.0, 2 * pi)
                new = np.array([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z])
                if (found @ new <= least).all():
                    found = np.vstack([found, new])
                    break
            else:
                break
        if len(found) == count:
            angles = np.degrees([np.arccos(found[:, 2]), np.arctan2(found[:, 1], found[:, 0]) % (2 * pi)])
            return np.asarray(angles.T)
    raise NoRoom(f"no room was found for {count} places at least {distance:g} degrees apart: fewer, or closer ones")


def refuse_no_room(count: int, polar: tuple[float, float], distance: float) -> None:
    """Compare the area of discs around the places with the area that they may lie in.

    Raises
    ------
    NoRoom
        If the discs are too large or too many even for a hexagonal packing.
    """
    half = radians(distance) / 2
    low, high = max(radians(polar[0]) - half, 0.0), min(radians(polar[1]) + half, pi)
    most = max(DENSEST * (cos(low) - cos(high)) / (1 - cos(half)), 1.0) if half else np.inf
    if count > most:
        raise NoRoom(
            f"{count} places at least {distance:g} degrees apart do not fit between the polar angles {polar[0]:g} and "
            f"{degrees(radians(polar[1])):g}: there is room for less than {int(most) + 1}"
        )
