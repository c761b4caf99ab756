"""The studies of many runs, with cases as a file says them."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.studies import points
from magshell_fenicsx.studies.compare import comparison as comparisons
from magshell_fenicsx.studies.design import search as designs
from magshell_fenicsx.studies.design import variables as design_variables
from magshell_fenicsx.studies.ensemble import ensemble as ensembles
from magshell_fenicsx.studies.ensemble import samples
from magshell_fenicsx.studies.study import study as studies
from magshell_fenicsx.studies.sweep import sweep as sweeps

sweep = partial(sweeps.sweep, make_case=Case.from_source)
ensemble = partial(ensembles.ensemble, make_case=Case.from_source)
study = partial(studies.study, make_case=Case.from_source)
compare = partial(comparisons.compare, make_case=Case.from_source)
design = partial(designs.design, make_case=Case.from_source)
variables = partial(design_variables.variables, make_case=Case.from_source)
make_samples = partial(samples.make_samples, make_case=Case.from_source)
with_earlier = partial(sweeps.with_earlier, make_case=Case.from_source)


def make_points(
    file: Path, axes: Sequence[points.Axis], settings: Sequence[str] = ()
) -> list[points.SweepPoint]:
    """All points of a sweep of a case's file."""
    return points.make_points(points.swept_source(file, axes, settings), axes, Case.from_source)
