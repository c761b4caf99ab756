"""Labels of modes by their symmetry, in records, tables and names of files.

The label is empty for a mode with the symmetry of its model. Modes that a reduced model excludes
are "antisymmetric" to the mirror plane of a half, or "m = 7" waves around a meridian. "torsion" are
vibrations around the axis of a meridian.
"""

ANTISYMMETRIC = "antisymmetric"
TORSION = "torsion"
WAVES = "m = "  # begin of the label of waves


def wave_label(m: int) -> str:
    """Return the label of m waves around a meridian.

    Examples
    --------
    >>> wave_label(7)
    'm = 7'
    """
    return f"{WAVES}{m}"


def waves_of_label(label: str) -> int | None:
    """Return the number of waves around a meridian: 0 for torsion, None for other modes.

    Examples
    --------
    >>> waves_of_label("m = 7"), waves_of_label("torsion"), waves_of_label("antisymmetric")
    (7, 0, None)
    """
    if label == TORSION:
        return 0
    return int(label.removeprefix(WAVES)) if label.startswith(WAVES) else None


def breaks_symmetry(label: str) -> bool:
    """Return whether modes with this label are excluded by a reduced model.

    Examples
    --------
    >>> breaks_symmetry("m = 7"), breaks_symmetry("antisymmetric"), breaks_symmetry("asymmetric")
    (True, True, False)
    """
    return label == ANTISYMMETRIC or label.startswith(WAVES)
