"""A linear Gaussian model of the faces of a population: shape, albedo, gloss and
translucency together on the common (u, v), by probabilistic principal components
(Tipping and Bishop 1999) of blocks of equal variance, as in active appearance models
(Cootes et al. 2001).
"""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation
from xarray import DataArray, Dataset

from skindb.analysis.study import each_take, skipped_takes
from skindb.analysis.subjects import Subjects, require_adjustable, takes_to_compare
from skindb.errors import require
from skindb.schema import dataset, variables
from skindb.schema.cohort import require_comparable
from skindb.schema.label import CHANNELS
from skindb.schema.notes import Note, note
from skindb.types import Array, Mask, finite_rows, float64


class Block(NamedTuple):
    """A property of faces: a variable of their maps, or its logarithm."""

    variable: str
    quantities: tuple[str, ...]
    exported: str  # group in the files of AlbedoMM


LOG = "log "
POSITION = variables.TEXEL_SURFEL_POSITION
ALBEDO = variables.TEXEL_DIFFUSE_REFLECTANCE
BLOCKS = {
    "shape": Block(POSITION, ("x", "y", "z"), "shape"),
    "albedo": Block(ALBEDO, tuple(f"{LOG}R_d {c}" for c in CHANNELS), "diffuseAlbedo"),
    "gloss": Block(
        variables.TEXEL_SURFACE_REFLECTANCE, ("surface reflectance",), "specularAlbedo"
    ),
    "translucency": Block(
        variables.TEXEL_SIGMA_TR,
        tuple(f"{LOG}sigma_tr {c}" for c in CHANNELS),
        "translucency",
    ),
}
SIZE = 256  # maximum number of texels along each side: 1 mm, the accuracy of landmarks
LEAST_KNOWN = 0.5  # of the texels that any take has; takes with fewer are skipped
ALIGNMENTS = 3  # rounds of the alignment of shapes to their mean
MIN_SUBJECTS = 5  # means of fewer people show individuals
SAME = 1e-5  # differences of faces over their mean, which rounding explains
SAMPLES = 1000  # whose distance from the nearest subject is reported
DIMS = ("quantity", "v", "u")
MAPS = (variables.FACE_MEAN, variables.FACE_MODE, variables.FACE_SLOPE)


def face_model(
    cohort: Dataset,
    *,
    k: int = 5,
    adjust: Sequence[str] = (),
    rng: np.random.Generator,
) -> Dataset:
    """Mean face and principal modes of a population, with the covariance between blocks.

    A face is face_mean + face_slope (z - term_mean) + face_mode t + face_scale e, with
    attributes z, t ~ N(0, 1) and e ~ N(0, noise_variance). The unit is the subject:
    takes in the condition normal are aligned by rotation and translation, and averaged.
    Every block (shape, albedo, gloss, translucency) that all takes have is divided by the
    root of its total variance between subjects, so that all have the same weight.

    Parameters
    ----------
    cohort
        ``db.cohort("maps")``.
    k
        Maximum number of modes; n subjects and a regression with r terms have at most
        n - r - 2, because every subject is held out once.
    adjust
        Attributes on which faces are regressed.
    rng
        Random generator of samples whose distance from the subjects is reported.

    Returns
    -------
    Dataset
        (quantity, v, u) `face_mean`, `face_mode` for one standard deviation, and
        `face_slope`; NaN at texels that a subject lacks. `face_scale`,
        `noise_variance`, `term_mean`, `mode_variance_ratio`, `mode_largest_subject`,
        `mode_score`. Of every subject in the model of the others:
        `reconstruction_error` (mode_count, block), `face_distance`,
        `face_log_density`. Attributes: `skipped`; `used_fraction` of the texels;
        `nearest_subject`, the median distance of samples from the nearest subject over
        that of subjects, within the modes.

    Raises
    ------
    InputError
        With fewer than five subjects, or if no texel is known in all of them.
    """
    require_comparable(cohort, "maps")
    subjects = _subject_faces(cohort, adjust)
    quantities = subjects.quantities
    blocks = [name for name in BLOCKS if BLOCKS[name].quantities[0] in quantities]
    rows = [block_rows(quantities, name) for name in blocks]
    results = _fit(subjects.faces, subjects.design, rows, k)
    for name in MAPS:
        maps = np.full((*results[name].shape[:-1], *subjects.used.shape), np.nan)
        maps[..., subjects.used] = results[name]
        results[name] = maps
    model = dataset(
        results,
        coords={
            "quantity": quantities,
            "term": subjects.terms,
            "block": blocks,
            "mode": np.arange(1, len(results[variables.FACE_MODE]) + 1),
            "subject": subjects.names,
        },
        attrs={
            "skipped": skipped_takes(cohort) + subjects.skipped,
            "used_fraction": float(subjects.used.mean()),
        },
    )
    return model.assign_attrs(nearest_subject=_nearest_subject(model, rng))


class Faces(NamedTuple):
    """One face of every subject, and the design of a regression."""

    faces: Array  # (subject, quantity, texel)
    quantities: list[str]
    used: Mask  # (v, u) texels that all have
    names: list[str]
    terms: list[str]
    design: Array  # (subject, term)
    skipped: list[Note]


def _subject_faces(cohort: Dataset, adjust: Sequence[str]) -> Faces:
    """Means of the aligned takes of every subject in the condition normal."""
    takes, subjects = takes_to_compare(cohort, None)
    names = [block.variable for block in BLOCKS.values()]
    vectors = xr.concat(each_take(face_vector, takes, names), takes["take"])
    # without a probe there is no translucency
    is_measured = vectors.notnull().any(["v", "u"]).all("take").values
    vectors = vectors[:, is_measured]
    is_known = np.isfinite(vectors.values).all(axis=1)
    fraction = is_known[:, is_known.any(axis=0)].mean(axis=1)
    rows = np.flatnonzero(fraction >= LEAST_KNOWN)
    used = is_known[rows].all(axis=0)
    require(
        len(rows) and used.any(),
        "face model",
        "some texels must be known in every take",
        "none",
        "name other takes with --take",
    )
    skipped = [
        note(subjects.take[i], f"only {fraction[i]:.0%} of its texels are known")
        for i in np.flatnonzero(fraction < LEAST_KNOWN)
    ]
    faces = np.stack([vectors.values[row][:, used] for row in rows])
    faces[:, :3] = _aligned(faces[:, :3])
    subjects = subjects.select(rows)
    terms, design = _design(subjects, adjust)
    complete = finite_rows(design)
    chosen = [*itertools.compress(subjects.names, complete)]
    skipped += [
        note(name, f"lacks {' or '.join(adjust)}")
        for name in itertools.compress(subjects.names, ~complete)
    ]
    require(
        chosen,
        "face model",
        f"subjects must have {' and '.join(adjust)}",
        "none",
        "adjust for fewer attributes",
    )
    faces = np.stack([faces[subjects.rows_of(name)].mean(axis=0) for name in chosen])
    quantities = vectors["quantity"].values.tolist()
    return Faces(faces, quantities, used, chosen, terms, design[complete], skipped)


def block_rows(quantities: Sequence[str], block: str) -> Mask:
    """Which quantities belong to a block."""
    return np.isin(quantities, BLOCKS[block].quantities)


def face_vector(face: Dataset, *, size: int = SIZE) -> DataArray:
    """Quantities (quantity, v, u) of a face from its maps, with at most `size` texels along
    each side: positions, surface reflectance, and logarithms of R_d and sigma_tr.
    """
    step = max(face.sizes["v"] // size, 1)
    texels = face.coarsen(v=step, u=step, boundary="trim").reduce(np.mean)
    blocks = [block for block in BLOCKS.values() if block.variable in face]
    values = np.dstack([texels[block.variable].values for block in blocks])
    names = [name for block in blocks for name in block.quantities]
    is_log = [name.startswith(LOG) for name in names]
    values[..., is_log] = np.log(values[..., is_log])
    return DataArray(np.moveaxis(values, -1, 0), {"quantity": names}, DIMS)


def face_maps(vector: DataArray) -> Dataset:
    """Maps of a face from its quantities: the inverse of `face_vector`."""
    maps = {}
    for name, block in BLOCKS.items():
        part = vector.values[block_rows(vector["quantity"].values.tolist(), name)]
        part = np.exp(part) if block.quantities[0].startswith(LOG) else part
        if len(part):
            maps[block.variable] = (
                np.moveaxis(part, 0, -1) if len(part) > 1 else part[0]
            )
    return dataset(maps, coords={"channel": CHANNELS})


def _aligned(shapes: Array) -> Array:
    """Shapes (n, 3, texel) after rotation and translation to their mean (generalised
    Procrustes alignment without scale).
    """
    mean = shapes[0]
    for _ in range(ALIGNMENTS):
        mean = mean - mean.mean(axis=1, keepdims=True)
        shapes = np.stack([_align(shape, mean) for shape in shapes])
        mean = shapes.mean(axis=0)
    return shapes


def _align(shape: Array, target: Array) -> Array:
    """A shape (3, ...) after the rotation and translation to a target."""
    is_known = np.isfinite(shape + target).all(axis=0)
    points = [x[:, is_known].T for x in (shape, target)]
    centre, place = (x.mean(axis=0) for x in points)
    turn, _ = Rotation.align_vectors(points[1] - place, points[0] - centre)
    moved = turn.apply(shape.reshape(3, -1).T - centre) + place
    return np.asarray(moved.T.reshape(shape.shape))


def _design(subjects: Subjects, adjust: Sequence[str]) -> tuple[list[str], Array]:
    """Terms of a regression, and their values (subject, term): numbers, and indicators of
    all words but the first; NaN where an attribute is unknown.
    """
    require_adjustable(subjects, adjust)
    terms = []
    columns: list[Array] = [np.empty((len(subjects.names), 0))]
    for name in adjust:
        subjects.require_constant(name)
        attribute = subjects.by_subject(name, subjects.names)
        attribute.require_one_kind()
        require(
            len(attribute.words) > 1,
            f"adjust {name}",
            "must differ between subjects",
            ", ".join(attribute.words) or "no value",
            "omit it",
        )
        if attribute.is_numeric:
            terms.append(name)
            columns.append(attribute.numbers[:, None])
        else:
            terms += [f"{name}:{word}" for word in attribute.words[1:]]
            columns.append(attribute.columns)
    return terms, np.concatenate(columns, axis=1)


def _fit(faces: Array, design: Array, blocks: Sequence[Mask], k: int) -> dict[str, Any]:
    """The model of faces (subject, quantity, texel) with a design (subject, term)."""
    n, _, texels = faces.shape
    mean = faces.mean(axis=0)
    faces = faces - mean
    inner = np.stack([_inner(faces[:, rows]) for rows in blocks])
    regressors = np.column_stack([np.ones(n), design - design.mean(axis=0)])
    k = min(k, n - int(np.linalg.matrix_rank(regressors)) - 1)
    level = SAME * np.array([np.linalg.norm(mean[rows]) for rows in blocks])
    require(
        n >= MIN_SUBJECTS and k > 0 and (np.trace(inner.T) > level**2).all(),
        "face model",
        f"needs {MIN_SUBJECTS} subjects who differ, and three more than terms",
        f"{n} subjects",
        "add subjects, or adjust for fewer attributes",
    )
    modes = _modes(inner, regressors, k)
    squares, square, outside, determinant = _left_out(inner, regressors, k)
    noise = outside.mean() / (mean.size - k)
    loading = modes.weights * np.sqrt(np.maximum(1 - noise / modes.variance, 0.0))
    slope = np.float32(np.linalg.pinv(regressors)[1:])
    # the error of a shape is the distance of points
    channels = np.array([1, *(rows.sum() for rows in blocks[1:])])
    spread = np.einsum("nk,bnm,mk->kb", modes.weights, inner, modes.weights)
    return {
        variables.FACE_MEAN: mean,
        variables.FACE_MODE: np.tensordot(np.float32(loading.T), faces, 1),
        variables.FACE_SLOPE: np.tensordot(slope, faces, 1),
        variables.TERM_MEAN: design.mean(axis=0),
        variables.FACE_SCALE: modes.scale @ np.array(blocks),
        variables.NOISE_VARIANCE: noise,
        variables.MODE_VARIANCE_RATIO: spread / modes.scale**2,
        variables.MODE_LARGEST_SUBJECT: (modes.vectors**2).max(axis=0),
        variables.MODE_SCORE: modes.vectors * np.sqrt(modes.free),
        variables.RECONSTRUCTION_ERROR: np.sqrt(
            squares.mean(axis=0) / (texels * channels)
        ),
        variables.FACE_DISTANCE: np.sqrt(square),
        variables.FACE_LOG_DENSITY: _log_density(
            mean.size, k, noise, determinant, square + outside / noise
        ),
    }


def _inner(vectors: Array) -> Array:
    """Inner products (n, n) of vectors (n, ...)."""
    flat = vectors.reshape(len(vectors), -1).astype(float)
    return np.asarray(flat @ flat.T)


class Modes(NamedTuple):
    """Modes of the residuals of a regression, from inner products of the subjects."""

    hat: Array  # (n, n) by which values become residuals
    free: int  # degrees of freedom
    scale: Array  # (block,) root of the total variance
    vectors: Array  # (n, k) unit vectors
    variance: Array  # (k,) of the scaled blocks

    @property
    def weights(self) -> Array:
        """Subjects (n, k) whose weighted sum is one standard deviation of a mode."""
        return np.asarray(self.hat @ self.vectors / np.sqrt(self.free))


def _modes(inner: Array, regressors: Array, k: int) -> Modes:
    """Modes from inner products (block, n, n) and a design (n, p)."""
    hat = np.eye(len(regressors)) - regressors @ np.linalg.pinv(regressors)
    free = round(float(np.trace(hat)))
    residual = hat @ inner @ hat
    scale = np.sqrt(np.trace(residual.T) / free)
    values, vectors = np.linalg.eigh(np.tensordot(scale**-2, residual, 1) / free)
    return Modes(hat, free, scale, vectors[:, : -k - 1 : -1], values[: -k - 1 : -1])


def _left_out(inner: Array, regressors: Array, k: int) -> list[Array]:
    """Every subject in the model of the others: squared errors (n, k + 1, block) with
    each number of modes, squared Mahalanobis distance within the modes (n,), squared
    scaled part outside of them (n,), log determinant of the variance of the modes (n,).
    """
    n = len(regressors)
    rows = []
    for i in range(n):
        others = np.arange(n) != i
        modes = _modes(inner[:, others][..., others], regressors[others], k)
        # the subject less its expectation, as a weighted sum of subjects
        rest = np.zeros((n, k + 1))
        rest[i] = 1
        rest[others] = -(regressors[i] @ np.linalg.pinv(regressors[others]))[:, None]
        products = np.tensordot(modes.scale**-2, inner[:, others] @ rest[:, 0], 1)
        score = modes.weights.T @ products / modes.variance
        rest[others, 1:] -= np.cumsum(modes.weights * score, axis=1)
        squares = np.einsum("nk,bnm,mk->kb", rest, inner, rest)
        outside = squares[-1] @ modes.scale**-2
        rows.append((squares, score @ score, outside, np.log(modes.variance).sum()))
    return [np.array(column) for column in zip(*rows, strict=True)]


def _log_density(size: int, k: int, noise: float, determinant: Any, square: Any) -> Any:
    """Log density of `size` entries at a squared Mahalanobis distance, by the log
    determinant of their covariance within k modes.
    """
    outside = (size - k) * np.log(noise)
    return -(size * np.log(2 * np.pi) + outside + determinant + square) / 2


def _nearest_subject(model: Dataset, rng: np.random.Generator) -> float:
    """Median distance of samples from the nearest subject over that of subjects, within
    the modes.
    """
    deviation = model[variables.MODE_VARIANCE_RATIO].values.sum(axis=1) ** 0.5
    subjects = KDTree(model[variables.MODE_SCORE].values * deviation)
    samples = rng.standard_normal((SAMPLES, len(deviation))) * deviation
    between = subjects.query(subjects.data, 2)[0][:, 1]
    return float(np.median(subjects.query(samples)[0]) / np.median(between))


def _expected(model: Dataset, attributes: Mapping[str, float]) -> DataArray:
    """Mean (quantity, v, u) of faces with these values of terms, others as in the mean."""
    terms = model["term"].values.tolist() if "term" in model.coords else []
    mean = model[variables.FACE_MEAN]
    for name, value in attributes.items():
        require(
            name in terms,
            f"attribute {name}",
            "must be a term of the regression of the model",
            "another name",
            f"choose from {', '.join(terms) or 'none'}",
        )
        term = model.isel(term=terms.index(name))
        change = value - term[variables.TERM_MEAN]
        mean = mean + change * term[variables.FACE_SLOPE]
    return mean


def face_at(model: Dataset, scores: ArrayLike = (), **attributes: float) -> Dataset:
    """A face of a model, as maps.

    Parameters
    ----------
    model
        From `face_model` or `condition_face_model`.
    scores
        Of the first modes, in standard deviations; 0 for the others.
    attributes
        Values of terms of the regression, such as age=40, or 0 or 1 for a word
        (``**{"gender:male": 1}``); others are those of the mean.

    Returns
    -------
    Dataset
        `texel_surfel_position`, `texel_diffuse_reflectance`,
        `texel_surface_reflectance`, `texel_sigma_tr`, as far as the model has them.
    """
    steps = float64(scores)
    modes = model[variables.FACE_MODE].values[: len(steps)]
    return face_maps(_expected(model, attributes) + np.tensordot(steps, modes, 1))


def sample_faces(
    model: Dataset, *, rng: np.random.Generator, count: int = 1, **attributes: float
) -> Dataset:
    """Faces (sample,) drawn from a model, without its noise; see `face_at`."""
    scores = rng.standard_normal((count, model.sizes["mode"]))
    return xr.concat([face_at(model, one, **attributes) for one in scores], "sample")


def condition_face_model(
    model: Dataset, observed: Dataset, **attributes: float
) -> Dataset:
    """The model of faces of which a part is known, such as the albedo from the shape.

    Parameters
    ----------
    model
        From `face_model`.
    observed
        Maps of a face, of some blocks and texels (NaN elsewhere), which the model was not
        made from.
    attributes
        See `face_at`.

    Returns
    -------
    Dataset
        `face_mean` is the conditional mean, and `face_mode` a root of the conditional
        covariance, for `face_at` and `sample_faces`. Attributes say how unusual the
        known part is: `distance` (Mahalanobis) of the posterior scores, `log_density`,
        and for complete faces `p`, the fraction of faces with a density as low, from the
        ranks of the subjects held out.
    """
    expected = _expected(model, attributes).values.astype(float)
    vector = face_vector(observed, size=model.sizes["v"])
    values = vector.reindex(quantity=model["quantity"].values.tolist()).values
    if POSITION in observed:
        values[:3] = _align(values[:3], expected[:3])
    scale = model[variables.FACE_SCALE].values[:, None, None]
    residual = (values - expected) / scale
    is_known = np.isfinite(residual)
    y = residual[is_known]
    require(y.size, "face", "must have texels of the model", "none", "give other maps")
    modes = model[variables.FACE_MODE].values.astype(float)
    loading = (modes / scale)[:, is_known]
    noise = float(model[variables.NOISE_VARIANCE])
    precision = loading @ loading.T + noise * np.eye(len(modes))
    scores = np.linalg.solve(precision, loading @ y)
    root = np.linalg.cholesky(noise * np.linalg.inv(precision))
    square = (y @ y - scores @ loading @ y) / noise
    determinant = np.linalg.slogdet(precision)[1]
    density = _log_density(y.size, len(modes), noise, determinant, square)
    lower = model[variables.FACE_LOG_DENSITY].values <= density
    mean = np.where(is_known, values, expected + np.tensordot(scores, modes, 1))
    remaining = np.where(is_known, 0.0, np.tensordot(root.T, modes, 1))
    maps = {
        variables.FACE_MEAN: (DIMS, mean),
        variables.FACE_MODE: (("mode", *DIMS), remaining),
    }
    attrs = {"distance": float(np.linalg.norm(scores)), "log_density": float(density)}
    if (is_known == np.isfinite(expected)).all():
        attrs["p"] = (1 + int(lower.sum())) / (1 + len(lower))
    return model.drop_dims("term", errors="ignore").assign(maps).assign_attrs(attrs)
