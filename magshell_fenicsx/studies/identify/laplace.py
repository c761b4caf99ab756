"""Parameters from measured numbers: the fit, its posterior, and the next measurement.

The fit is by Gauss-Newton on exact slopes, the posterior by Laplace's approximation. With data d,
their noise s and priors m +- t, the fit is least in

    F(x) = sum ((d - y(x))/s)^2 + sum ((x - m)/t)^2,

and the posterior near it is normal with the covariance C = (J^T J/s^2 + 1/t^2)^-1, J = dy/dx (A.
Tarantola, Inverse Problem Theory, SIAM 2005, section 3.2). Where s is estimated, from the residuals
of a column over its degrees of freedom f, quantiles are those of Student's t. A variance V that is
the sum of parts V_c, one of the noise of each column and one of priors, has the degrees of freedom
V^2/sum (V_c^2/f_c) (F. E. Satterthwaite, Biometrics Bulletin 2, 110, 1946).

n data are in columns, each with one noise, the standard deviation of its errors; p parameters x
have the prediction y(x) (n,) and slopes J (n, p). The misfit is F at the fit. A residual or slope
is weighed when it is over its standard deviation. A field is a block of parameters with a common
prior, whose strengths are a deviation and a length (see `smooth`). The size of a parameter is its
scale, by which it is multiplied for good conditioning. Knows no shell.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.identify.smoothness_prior import Smooth

Array = NDArray[np.float64]
# x (p,) -> y (n,) and J (n, p); None where there is none
Model = Callable[[Array], tuple[Array, Array] | None]

CONVERGED = 1e-3  # a step below this part of a standard deviation is the last one
HALVINGS = 10
RANK_TOLERANCE = (
    1e-6  # a smaller singular value, over the largest, is a combination that data do not see
)
MIN_NAMED_COMPONENT = 0.1  # parts of a direction that are named
BAND_PROBABILITY = 0.95  # of the bands
MIN_FREEDOM = 1.0  # degree of freedom
MIN_NOISE_FREEDOM = 0.5  # of a degree: with less, data do not say their noise
MIN_RELATIVE_NOISE = 1e-12  # no estimated noise is less than this part of the data
LOG_STRENGTH_STEP = 0.05  # differences of logarithms of strengths
# of their posterior, wider than a normal one, whose logarithms are sure to 1.4
SAMPLES, WIDER, SUREST = 64, 1.3, 0.5
MOST_AXES = 8  # of the posterior, the longest ones, along which it is looked at
NORMAL = (
    0.25  # difference of the misfit from its parabola up to which the posterior counts as normal
)


class NotSeen(ValueError):
    """Data and priors leave a combination of parameters open.

    Attributes
    ----------
    numbers
        Indices of the parameters of this combination.
    """

    def __init__(self, numbers: NDArray[np.int64]) -> None:
        self.numbers = [int(number) for number in numbers]
        super().__init__(f"parameters {self.numbers} are not determined")


class NoNoise(ValueError):
    """Parameters follow the data of this column so closely that these do not say their noise."""

    def __init__(self, column: int) -> None:
        self.column = column
        super().__init__(f"the noise of column {column} is not determined")


@dataclass(frozen=True)
class Measured:
    """Measured data, their noise, and the priors of the parameters.

    Attributes
    ----------
    data
        (n,) measured numbers.
    group
        (n,) index of the column of each number.
    noise
        Standard deviation of the noise of each column; nan where it is to be estimated.
    mean, deviation
        (p,) mean and standard deviation of the priors; the deviation is infinite without a prior.
    field
        The prior of a field among the parameters; `deviation` is infinite for its numbers.
    """

    data: Array
    group: NDArray[np.int64]
    noise: Array
    mean: Array
    deviation: Array
    field: Smooth | None = None

    @property
    def prior(self) -> Array:
        """Matrix W (p, p) of the priors; zero rows without a prior.

        If parameters x have their prior distribution, W (mean - x) has independent components with
        standard deviation one.
        """
        W = np.diag(1 / self.deviation)  # each parameter for itself
        if self.field:  # the numbers of a field depend on each other: a block of its own
            W[self.field.block, self.field.block] = self.field.rows
        return np.asarray(W)

    def rows(self, y: Array, J: Array, x: Array, noise: Array) -> tuple[Array, Array]:
        """Return residuals (n + p,) and slopes (n + p, p) over their standard deviations.

        The rows of the data are first, then those of the priors. The squared length of the
        residuals is the misfit F(x).

        Parameters
        ----------
        y, J
            (n,) and (n, p), prediction and its derivatives.
        x
            (p,) parameters.
        noise
            Standard deviation of the noise of each column.
        """
        noise_of_data, W = noise[self.group], self.prior
        residuals = np.concatenate([(self.data - y) / noise_of_data, W @ (self.mean - x)])
        return residuals, np.vstack([J / noise_of_data[:, None], W])


@dataclass(frozen=True)
class Posterior:
    """The posterior of the parameters: a Gaussian about the best fit (Laplace's approximation).

    Attributes
    ----------
    x, y, slopes
        Parameters (p,), the prediction there (n,), and its derivatives (n, p).
    group
        (n,) index of the column of each datum.
    noise, freedom
        Standard deviation of the noise of each column, and the degrees of freedom from which it is
        estimated (infinite if it is given).
    covariance
        (p, p) covariance of the posterior.
    misfit
        Sum of the squared residuals over their standard deviations, with those of the priors.
    steps
        Number of Gauss-Newton steps.
    ended
        Reason why the iteration ended.
    measured
        Data and priors, with the prior of a field as strong as the data have chosen it.
    """

    x: Array
    y: Array
    slopes: Array
    group: NDArray[np.int64]
    noise: Array
    freedom: Array
    covariance: Array
    misfit: float
    steps: int
    ended: str
    measured: Measured

    @property
    def deviation(self) -> Array:
        """Standard deviations (p,) of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def local(self) -> Array:
        """Covariance (p, p) at the noise and the field's strengths of the fit.

        Unlike `covariance` it ignores that these strengths are uncertain.
        """
        if not self.measured.field:
            return self.covariance
        _, scaled_slopes = self.measured.rows(self.y, self.slopes, self.x, self.noise)
        return _covariance(scaled_slopes, self.deviation)

    @property
    def correlation(self) -> Array:
        """Correlation matrix (p, p) of the parameters."""
        return np.asarray(self.covariance / np.outer(self.deviation, self.deviation))

    def quantiles(self, slopes: Array, column: NDArray[np.int64] | None = None) -> Array:
        """Return half widths of 95 % bands over standard deviations, (k,) quantiles of Student's t.

        The bands are those of k numbers that are linear in the parameters. The degrees of freedom
        are Satterthwaite's, see the module: V^2/sum (V_c^2/f_c), where V_c is the part of the
        variance V of a number that is due to the noise of column c.

        Parameters
        ----------
        slopes
            (k, p) derivatives of k numbers by the parameters.
        column
            (k,) index of the column whose noise each number has besides, if it is a measured one;
            None: the numbers are predictions without noise.
        """
        # (k, n) part of the variance of each number that is due to the noise of each datum
        data_variances = (slopes @ self.covariance @ self.slopes.T / self.noise[self.group]) ** 2
        # V_c, (k, columns), and V, (k,)
        columns = np.arange(len(self.noise))
        column_variances = np.array(
            [data_variances[:, self.group == number].sum(axis=1) for number in columns]
        ).T
        variance = self.spread(slopes) ** 2
        if column is not None:  # a measured number has the noise of its own column besides
            noise_variance = self.noise[column] ** 2
            is_own_column = column[:, None] == columns
            column_variances = column_variances + noise_variance[:, None] * is_own_column
            variance = variance + noise_variance
        # V_c/V, (k, columns)
        variance_shares = column_variances / np.where(variance > 0, variance, 1.0)[:, None]
        with np.errstate(divide="ignore"):  # infinite freedom if the noise of all columns is given
            freedom = 1 / (variance_shares**2 / self.freedom).sum(axis=1)
        return np.asarray(scipy.stats.t.ppf((1 + BAND_PROBABILITY) / 2, freedom))

    @property
    def band(self) -> tuple[Array, Array]:
        """Lower and upper ends (p,) of the 95 % bands of the parameters."""
        half_width = self.quantiles(np.eye(len(self.x))) * self.deviation
        return self.x - half_width, self.x + half_width

    def spread(self, slopes: Array) -> Array:
        """Return standard deviations (k,) of numbers with slopes (k, p), without noise."""
        return np.asarray(np.sqrt(np.einsum("ki,ij,kj->k", slopes, self.covariance, slopes)))

    def narrowed(self, slope: Array, noise: float) -> Array:
        """Return the standard deviations (p,) of the parameters after one more measurement.

        Parameters
        ----------
        slope, noise
            (p,) derivatives of the measured number, and the standard deviation of its noise.
        """
        # with g = C slope and the variance v of the measured number, the new covariance is
        # C - g g^T/v
        slope_covariance = self.covariance @ slope
        variance = noise**2 + slope @ slope_covariance
        reduction = slope_covariance**2 / variance if variance > 0 else 0.0
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance) - reduction, 0.0)))


def fit_posterior(
    model: Model,
    measured: Measured,
    start: Array,
    size: Array,
    max_steps: int,
    report_step: Callable[[int, Array, float, Array], None],
) -> Posterior:
    """Fit the parameters by Gauss-Newton; steps are halved until the misfit falls.

    After each step, noise that is not given and strengths of a field's prior are estimated anew.

    Parameters
    ----------
    model
        Parameters (p,) -> prediction and slopes; None where there is none.
    measured
        Data, noise and priors, with nan for noise and strengths that are to be found.
    start, size
        (p,) where the iteration starts, and the scale of each parameter, for conditioning.
    max_steps
        Largest number of steps.
    report_step
        Called with the number of each step, its parameters, the misfit over the number of data, and
        the noise of each column.

    Raises
    ------
    NotSeen
        If data and priors leave a combination of parameters open.
    NoNoise
        If the noise of a column is to be estimated, and the parameters follow its data.
    """
    first_prediction = model(start)
    assert first_prediction, "there is a prediction at the start"
    # `initial` keeps nan for what is unknown; `measured` has its present estimate
    x, (y, J), initial = np.array(start), first_prediction, measured
    noise = _first_noise(measured, y)
    measured, noise, freedom = _with_strengths_and_noise(initial, measured, x, y, J, noise, size)
    ended = f"{max_steps} steps"
    for step in range(max_steps + 1):
        scaled_residuals, A = measured.rows(y, J, x, noise)
        _refuse_unseen(A * size)
        misfit = float(scaled_residuals @ scaled_residuals)
        report_step(step, x, misfit / len(measured.data), noise)
        if step == max_steps:  # the last pass only reports
            break
        # the full step, by least squares in scaled parameters; the iteration ends if the step is
        # short for each parameter
        dx = size * np.linalg.lstsq(A * size, scaled_residuals, rcond=None)[0]
        covariance = _covariance(A, size)
        deviation = np.sqrt(np.diag(covariance))
        if (np.abs(dx) < CONVERGED * deviation).all():
            ended = "converged"
            break
        lowered = _lowered(model, measured, noise, x, dx, misfit)
        if lowered is None:
            ended = "no step lowers the misfit"
            break
        x, (y, J) = lowered
        measured, noise, freedom = _with_strengths_and_noise(
            initial, measured, x, y, J, noise, size
        )
    _refuse_without_noise(freedom)
    _, A = measured.rows(y, J, x, noise)
    covariance = _covariance(A, size)
    if measured.field:  # the strengths of its prior are uncertain too
        covariance = _Strength(initial, measured, x, y, J, noise, size).covariance()
    return Posterior(
        x=x,
        y=y,
        slopes=J,
        group=measured.group,
        noise=noise,
        freedom=np.maximum(freedom, MIN_FREEDOM),
        covariance=covariance,
        misfit=misfit,
        steps=step,
        ended=ended,
        measured=measured,
    )


def _refuse_without_noise(freedom: Array) -> None:
    """Check that data leave enough degrees of freedom, of each column, to estimate its noise.

    Raises
    ------
    NoNoise
        With the first column whose data the parameters follow too closely.
    """
    columns_without_noise = np.flatnonzero(freedom < MIN_NOISE_FREEDOM)
    if columns_without_noise.size:
        raise NoNoise(int(columns_without_noise[0]))


def _lowered(
    model: Model, measured: Measured, noise: Array, x: Array, dx: Array, misfit: float
) -> tuple[Array, tuple[Array, Array]] | None:
    """Halve a step until the misfit falls; return the parameters there, and their prediction.

    None if no step lowers the misfit.

    Parameters
    ----------
    noise
        Standard deviation of the noise of each column.
    x, dx
        (p,) parameters, and the full step.
    misfit
        Misfit at x.
    """
    for halved in range(HALVINGS):
        next_x = x + dx / 2**halved
        prediction = model(next_x)
        if prediction is not None:
            scaled_residuals, _ = measured.rows(*prediction, next_x, noise)
            if scaled_residuals @ scaled_residuals < misfit:
                return next_x, prediction
    return None


def _covariance(A: Array, size: Array) -> Array:
    """Return the covariance C = (A^T A)^-1, (p, p), by the singular values of A.

    Parameters
    ----------
    A
        (rows, p) slopes of data and priors over standard deviations.
    size
        (p,) scale of each parameter, for conditioning.
    """
    _, s, V = np.linalg.svd(A * size, full_matrices=False)
    root = size[:, None] * V.T / s
    return np.asarray(root @ root.T)


def _refuse_unseen(A: Array) -> None:
    """Check that every combination of parameters has an influence on data or priors.

    Only then the fit has one solution.

    Parameters
    ----------
    A
        (rows, p) slopes of data and priors over standard deviations, by scaled parameters.

    Raises
    ------
    NotSeen
        With the parameters of a combination without influence.
    """
    # a parameter alone without influence
    length = np.linalg.norm(A, axis=0)
    if (idle := np.flatnonzero(length == 0)).size:
        raise NotSeen(idle)
    # the last row of V is the combination with the least influence; columns are scaled to one
    _, s, V = np.linalg.svd(A / length, full_matrices=False)
    if len(s) < A.shape[1] or s[-1] < RANK_TOLERANCE * s[0]:
        raise NotSeen(np.flatnonzero(np.abs(V[-1]) > MIN_NAMED_COMPONENT))


def _first_noise(measured: Measured, y: Array) -> Array:
    """Return the noise of the columns to begin with: as given, or from the residuals.

    From residuals it is their root mean square.

    Parameters
    ----------
    y
        (n,) prediction at the start.
    """
    noise = np.array(measured.noise)
    for column in np.flatnonzero(np.isnan(noise)):
        # 1 if the start fits exactly, so that it can be divided by
        noise[column] = np.sqrt(np.mean((measured.data - y)[measured.group == column] ** 2)) or 1.0
    return noise


def _with_strengths_and_noise(
    initial: Measured, measured: Measured, x: Array, y: Array, J: Array, noise: Array, size: Array
) -> tuple[Measured, Array, Array]:
    """Choose the strengths of a field's prior, and estimate noise that is not given.

    With a field, strengths and noise are found together, as the most likely ones. Without a field
    there are no strengths, and the noise is estimated from the residuals.

    Parameters
    ----------
    initial
        Data and priors as given, with nan for unknown strengths.
    measured, noise
        Data and priors, and noise of each column, where the search begins.
    x, y, J
        Parameters (p,), prediction (n,) and its derivatives (n, p).
    size
        (p,) scale of each parameter.

    Returns
    -------
    measured
        Data and priors with the strengths that the data choose; unchanged without a field.
    noise, freedom
        Noise of each column, and its degrees of freedom.
    """
    if measured.field:
        measured, noise = _Strength(initial, measured, x, y, J, noise, size).best()
        _, freedom = _estimated_noise(measured, y, J, noise, size)
        return measured, noise, freedom
    noise, freedom = _estimated_noise(measured, y, J, noise, size)
    return measured, noise, freedom


@dataclass(frozen=True)
class _Strength:
    """Search for the strengths of a field's prior and the noise of columns that data make likely.

    The strengths are the deviation and the length of the prior (module `smooth`). Only strengths
    and noises that are not given vary. The vector z has their logarithms: strengths first, then
    noises. With the model linear about x, the probability p(d) of the data is known for each z.

    Attributes
    ----------
    initial
        Data and priors as given, with nan for what is unknown.
    measured, noise
        Data and priors, and noise of each column, where the search begins.
    x, y, J
        Parameters (p,), prediction (n,) and its derivatives (n, p), about which the model is
        linear.
    size
        (p,) scale of each parameter.
    """

    initial: Measured
    measured: Measured
    x: Array
    y: Array
    J: Array
    noise: Array
    size: Array

    @property
    def fields_of_priors(self) -> tuple[Smooth, Smooth]:
        """The field's prior as given, with nan for what is unknown, and where the search begins."""
        assert self.initial.field
        assert self.measured.field
        return self.initial.field, self.measured.field

    @property
    def unknown_strengths(self) -> NDArray[np.int64]:
        """Indices of the strengths that are not given: 0 deviation, 1 length."""
        given_prior, _ = self.fields_of_priors
        return np.flatnonzero(np.isnan([given_prior.deviation, given_prior.length]))

    @property
    def unknown(self) -> NDArray[np.int64]:
        """Columns whose noise is not given."""
        return np.flatnonzero(np.isnan(self.initial.noise))

    def z(self, deviation: float, length: float) -> Array:
        """Return the vector z of a deviation and a length, with the noise at the begin.

        z has the deviation only if it is not given, and the length only if it is not given.
        """
        strengths = np.array([deviation, length])
        return np.log([*strengths[self.unknown_strengths], *self.noise[self.unknown]])

    def weighed(self, z: Array) -> tuple[Measured, Array]:
        """Return data and priors with the strengths of z, and the noise of each column.

        Strengths and noises that z does not have are as given.
        """
        given_prior, _ = self.fields_of_priors
        strengths = np.array([given_prior.deviation, given_prior.length])
        noise = np.array(self.noise)
        # z has logarithms: strengths first, then noises
        count = len(self.unknown_strengths)
        strengths[self.unknown_strengths] = np.exp(z[:count])
        noise[self.unknown] = np.exp(z[count:])
        field = given_prior.with_strength(float(strengths[0]), float(strengths[1]))
        return replace(self.measured, field=field), noise

    def surprise(self, z: Array) -> float:
        """Return -2 ln p(d), up to a constant: how surprising the data are for strengths z.

        The parameters are integrated over. This leaves sum ln noise^2 - ln det Q + ln det A^T A,
        and the least misfit of the linear model. Q is the inverse covariance of the field, and A
        has the slopes of data and priors over their standard deviations.
        """
        measured, noise = self.weighed(z)
        residuals, A = self._rows(z)
        assert measured.field
        log_det_Q = measured.field.determinant
        # A = U R with orthonormal columns of U: the least misfit is the part of the residuals that
        # U does not span, and det A^T A = (det R)^2
        U, R = np.linalg.qr(A * self.size)
        smallest_misfit = residuals @ residuals - np.sum((U.T @ residuals) ** 2)
        noise_term = 2 * np.log(noise[measured.group]).sum()
        log_determinant = 2 * np.log(np.abs(np.diag(R))).sum()
        return float(noise_term - log_det_Q + log_determinant + smallest_misfit)

    def _rows(self, z: Array) -> tuple[Array, Array]:
        """Return residuals and slopes over their standard deviations, at x, for strengths z."""
        measured, noise = self.weighed(z)
        return measured.rows(self.y, self.J, self.x, noise)

    def best(self) -> tuple[Measured, Array]:
        """Return data and priors, and the noise of each column, for the most likely strengths.

        The search begins at the best of several starts.
        """
        given_prior, start_prior = self.fields_of_priors
        # of several starts the one under which the data are most likely
        starts = start_prior.starts(given_prior)
        z = min((self.z(deviation, length) for deviation, length in starts), key=self.surprise)
        if len(z):  # something is not given
            # pairs (least, largest) of the unknown strengths, then of the unknown noises
            bounds = [given_prior.bounds[i] for i in self.unknown_strengths]
            smallest_noise = MIN_RELATIVE_NOISE * float(np.abs(self.measured.data).max())
            bounds += [(smallest_noise, 1e3 * float(self.noise[i])) for i in self.unknown]
            limits = np.log(bounds)  # (len(z), 2)
            # first simplex: strengths and noises vary by exp(0.5)
            simplex = np.vstack([z, z + 0.5 * np.eye(len(z))]).clip(*limits.T)
            options = {
                "initial_simplex": simplex,
                "xatol": 1e-4,
                "fatol": 1e-6,
                "maxiter": 400 * len(z),
            }
            z = scipy.optimize.minimize(
                self.surprise, z, method="Nelder-Mead", bounds=limits, options=options
            ).x
        return self.weighed(z)

    def covariance(self) -> Array:
        """Return the posterior covariance (p, p), averaged over strengths and noises by likelihood.

        So the uncertainty of strengths and noises is in it. The average is over weighted samples
        about the best strengths, where the search begins (H. Rue, S. Martino and N. Chopin, J. R.
        Stat. Soc. B 71, 319, 2009, section 3).
        """
        _, start_prior = self.fields_of_priors
        z = self.z(start_prior.deviation, start_prior.length)
        count = len(self.unknown_strengths) + len(self.unknown)
        if not count:  # nothing to average over
            _, A = self._rows(z)
            return _covariance(A, self.size)
        samples, weights = self._weighted_samples(z)
        # second moments of the parameters about x, averaged over the samples
        total = np.zeros((len(self.x), len(self.x)))
        for k, weight in enumerate(weights):
            residuals, A = self._rows(samples[k])
            offset = self.size * np.linalg.lstsq(A * self.size, residuals, rcond=None)[0]
            # scatter of the parameters for this sample, and the offset of their best values from x
            total += weight * (_covariance(A, self.size) + np.outer(offset, offset))
        return total

    def _weighted_samples(self, z: Array) -> tuple[Array, Array]:
        """Return vectors (k, len(z)) that scatter about the best vector z, and their weights (k,).

        The samples are normal, along the principal axes of the curvature of -ln p(d) at z. They
        scatter a little more widely than a normal distribution with this curvature. A weight is
        the likelihood over the density of the samples (importance sampling); their sum is one.
        """
        curvatures, axes = np.linalg.eigh(self._curvature_matrix(z))
        scaled_axes = axes * WIDER / np.sqrt(np.maximum(curvatures, SUREST))
        # quasi-random; the first point of the sequence, zero, would be at infinity
        normal_samples = scipy.stats.norm.ppf(
            scipy.stats.qmc.Halton(len(z), scramble=False).random(SAMPLES + 1)[1:]
        )
        samples = z + normal_samples @ scaled_axes.T
        # logarithm of the likelihood, less that of the density
        logarithms = (
            np.array([-self.surprise(sample) / 2 for sample in samples])
            + (normal_samples**2).sum(axis=1) / 2
        )
        weights = np.exp(logarithms - logarithms.max())
        return samples, weights / weights.sum()

    def _curvature_matrix(self, z: Array) -> Array:
        """Return the second derivatives (len(z), len(z)) of -ln p(d) at z, by differences."""

        def second_difference(a: Array, b: Array) -> float:
            """Return the second derivative along two axes, with steps a and b.

            The differences are those of -2 ln p(d), between four points z +- a +- b.
            """
            differences = [
                sa * sb * self.surprise(z + sa * a + sb * b) for sa in (-1, 1) for sb in (-1, 1)
            ]
            return sum(differences) / (8 * LOG_STRENGTH_STEP**2)

        steps = LOG_STRENGTH_STEP * np.eye(len(z))

        def row_of_matrix(a: Array) -> list[float]:
            """Return the second derivatives along one axis, with step a, and along every axis."""
            return [second_difference(a, b) for b in steps]

        return np.array([row_of_matrix(a) for a in steps])


def _estimated_noise(
    measured: Measured, y: Array, J: Array, noise: Array, size: Array
) -> tuple[Array, Array]:
    """Estimate the noise of columns where it is not given, and its degrees of freedom.

    A noise is the root of the sum of squared residuals over their degrees of freedom. The freedom
    of a column is the number of its data, less the sum of their shares in determining the
    parameters: a share is an entry of the diagonal of J C J^T/s^2. The freedom is infinite where
    the noise is given.

    Parameters
    ----------
    y, J
        (n,) and (n, p), prediction and its derivatives.
    noise
        Noise s of each column at the last step, for the shares.
    size
        (p,) scale of each parameter.

    Returns
    -------
    noise, freedom
        Of each column.
    """
    # shares (n,) of the data
    noise_of_data = noise[measured.group]
    C = _covariance(np.vstack([J / noise_of_data[:, None], measured.prior]), size)
    shares = np.einsum("ni,ij,nj->n", J, C, J) / noise_of_data**2
    estimated, freedom = np.array(measured.noise), np.full(len(noise), np.inf)
    smallest_noise = MIN_RELATIVE_NOISE * np.abs(measured.data).max()
    for column in np.flatnonzero(np.isnan(measured.noise)):  # not given
        in_column = measured.group == column
        freedom[column] = in_column.sum() - shares[in_column].sum()
        sum_of_squares = ((measured.data - y)[in_column] ** 2).sum()
        residual_noise = np.sqrt(sum_of_squares / max(freedom[column], MIN_FREEDOM))
        estimated[column] = max(residual_noise, smallest_noise)
    return estimated, freedom


def nonlinearity(model: Model, posterior: Posterior) -> tuple[float, int]:
    """Compare the misfit with its parabola, at the ends of bands along the longest axes.

    The parabola is the misfit that a linear model would have: it rises from the fit by q^2 to the
    end of a band of q standard deviations. The axes are those of the posterior's ellipsoid, in
    parameters over their deviations. If the difference is small, the posterior is normal, and the
    bands are right.

    Parameters
    ----------
    model
        Parameters (p,) -> prediction, and slopes, which are not used here; None where there is
        none.

    Returns
    -------
    worst
        Largest difference over the parabola's rise, over all ends.
    lost_count
        Number of these ends at which nothing is predicted.
    """
    # the misfit is for the noise and the strengths of the fit, and so must be its parabola
    posterior = replace(posterior, covariance=posterior.local)
    size = posterior.deviation
    # the longest axes first, with the variances along them
    variances, axes = np.linalg.eigh(posterior.correlation)
    longest = np.argsort(-variances)[:MOST_AXES]
    variances, axes = variances[longest], axes[:, longest]
    quantiles = posterior.quantiles(axes.T / size)
    worst, lost_count = 0.0, 0
    for variance, axis, quantile in zip(variances, axes.T, quantiles, strict=True):
        for signed_quantile in (-quantile, quantile):
            x = posterior.x + signed_quantile * size * np.sqrt(max(variance, 0.0)) * axis
            prediction = model(x)
            if prediction is None:
                lost_count += 1
                continue
            scaled_residuals, _ = posterior.measured.rows(*prediction, x, posterior.noise)
            rise = float(scaled_residuals @ scaled_residuals - posterior.misfit)
            worst = max(worst, abs(rise / quantile**2 - 1))
    return worst, lost_count
