"""Skin of a virtual person: measured mean colours, and the albedo, gloss and translucency
of every vertex.

Colours: International Skin Spectra Archive (Lu et al. 2025), reflectance spectra of faces
converted to scene-linear Rec. 709 under D65, means over people by group and site.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial import cKDTree

from skindb.files import package_json
from skindb.optics.diffusion import dipole_s, scattering_coefficients
from skindb.types import Float64, float64, lengths
from skindb.virtual.head import Head
from skindb.virtual.person import Person

BLOOD_SPREAD = 0.06  # log green, between people of equal melanin
# BRDFs of the dictionary with wide lobes: narrow ones would be blurred by the curvature of
# the skin within a pixel. The first BASES are those of a person, of which the first
# two are mixed with the next two; a film of oil or water and powder add the last two.
MATERIALS = (
    "ggx 0.37",
    "ggx 0.24",
    "special-walnut-224",
    "ggx 0.15",
    "ggx 0.58",
    "cherry-235",
    "ggx 0.097",
    "polyurethane-foam",
)
SHARP = [1, 3]  # of BASES
# of one person, as in the paper; six in all conditions, eight in a population
BASES = 4
# of the dictionary, which an exact fit with noise of 1 % tells apart, the most
# different first; see benchmarks/planted_bases.py
DISTINCT = (
    "ggx 0.097",
    "black-phenolic",
    "blue-fabric",
    "ggx 0.15",
    "ggx 0.04",
    "ggx 0.37",
    "pearl-paint",
    "ggx 0.58",
)
PATCHES = 80  # with one of DISTINCT each
MIDDLE_AGE = 40.0  # years, at which age has no effect on gloss
MIX_SPREAD = 0.3  # between people, of the fraction of the second material of a pair
WAVES = 40  # of `smooth_noise`
PATCH = 6.0  # mm about a probe site over which its colour is averaged


def smooth_noise(
    points: Float64, wavelength: float, *, rng: np.random.Generator
) -> Float64:
    """A Gaussian-like field (n,) of zero mean and unit variance over `points` (n, 3)
    mm: a sum of plane waves.

    Wavelengths vary by a factor of two around `wavelength` mm, directions are uniform.
    """
    vector = rng.standard_normal((WAVES, 3))
    number = 2 * np.pi / (wavelength * rng.uniform(0.7, 1.4, WAVES))
    vector *= (number / lengths(vector))[:, None]
    phase = rng.uniform(0, 2 * np.pi, WAVES)
    # float32 is sufficient, and 40 cosines per vertex dominate the cost of a skin
    wave = np.cos(
        points.astype(np.float32) @ vector.T.astype(np.float32)
        + phase.astype(np.float32)
    )
    return wave.sum(axis=1, dtype=float) * np.sqrt(2 / WAVES)


@dataclass(frozen=True)
class ConditionEffect:
    """Effect of a condition on the skin."""

    gloss: float = 1.0  # factor on the specular albedo
    sharp: float = 1.0  # factor on the fractions of the SHARP bases
    film: float = 0.0  # fraction of the specular albedo
    powder: float = 0.0  # fraction of the specular albedo
    melanin: float = 0.0  # added log green
    blood: float = 0.0  # added log green
    even: float = 0.0  # fraction of the pigment's variation that is covered
    translucency: float = 1.0  # factor on sigma_tr


@dataclass(frozen=True)
class GlossEffects:
    """Effects of ancestry and age on gloss: the modeller's choice, no claim about anyone."""

    albedo: dict[str, float]  # factor on the specular albedo
    albedo_per_year: float  # of its logarithm
    second: dict[
        str, list[float]
    ]  # mean fractions of the second materials of the pairs
    second_per_year: list[float]


@dataclass(frozen=True)
class SkinTables:
    """The constants of skin.json."""

    sites: tuple[str, ...]
    mean: dict[tuple[str, str], Float64]  # ancestry and gender -> R_d (site, channel)
    # ancestry and gender -> relative standard deviation between people, green, cheek
    spread: dict[tuple[str, str], float]
    # by region, "elsewhere" for the others: albedo at normal incidence, fractions of BASES
    gloss: dict[str, list[float]]
    gloss_effects: GlossEffects
    sigma_tr: dict[str, Float64]  # paper, table 2: site -> mean (channel,) in mm^-1
    effects: dict[str, ConditionEffect]  # by condition

    @property
    def melanin(self) -> Float64:
        """Axis of melanin in log R_d, 1 in green: from one cheek to a darker one."""
        light, dark = (
            self.mean[group, "female"][self.sites.index("cheek")]
            for group in ("european", "african")
        )
        return _axis(light, dark)

    @property
    def haemoglobin(self) -> Float64:
        """Axis of haemoglobin in log R_d, 1 in green: from pale neck to ruddy chin."""
        mean = self.mean["european", "female"]
        neck, chin = (mean[self.sites.index(site)] for site in ("neck", "chin"))
        return _axis(neck, chin)


def _axis(light: Float64, dark: Float64) -> Float64:
    """Direction from a lighter to a darker colour in log reflectance, 1 in green."""
    step = np.log(light) - np.log(dark)
    return step / step[1]


@cache
def skin_tables() -> SkinTables:
    """The constants, read at their first use."""
    tables = package_json("skindb.virtual", "skin.json")
    people = {(row["ancestry"], row["gender"]): row for row in tables["people"]}
    return SkinTables(
        tuple(tables["sites"]),
        {group: np.array(row["mean"]) for group, row in people.items()},
        {group: row["spread"] for group, row in people.items()},
        {
            region: [row["albedo"], *row["fractions"]]
            for region, row in tables["gloss"].items()
        },
        GlossEffects(**tables["gloss_effects"]),
        {site: np.array(mean) for site, mean in tables["sigma_tr"].items()},
        {name: ConditionEffect(**row) for name, row in tables["effects"].items()},
    )


@dataclass(frozen=True)
class Site:
    """Site of the probe, and its optical parameters; arrays (channel,)."""

    name: str
    position: Float64  # (3,) mm
    diffuse_reflectance: Float64
    sigma_tr: Float64  # mm^-1
    sigma_a: Float64  # mm^-1
    sigma_s_prime: Float64  # mm^-1


@dataclass(frozen=True)
class Skin:
    """True parameters per vertex."""

    diffuse: Float64  # (n, 3) R_d
    weights: Float64  # (n, k) of `materials_of` the person
    bases: Float64  # (BASES, k) fractions of the materials, by albedo
    gloss: dict[str, float]  # factors on the specular albedo, by what causes them
    sigma_tr: Float64  # (n, 3) mm^-1
    sites: tuple[Site, ...]


def skin_of(
    head: Head, person: Person, *, material_albedo: Float64, eta: float
) -> Skin:
    """The skin of `person` on `head`.

    Parameters
    ----------
    head
        Vertices, landmarks and region memberships.
    person
        Age, gender, ancestry, condition and individual variation.
    material_albedo
        Directional albedo (k,) of `materials_of` the person at normal incidence, by which
        the weights are scaled.
    eta
        Index of refraction for the conversion of (R_d, sigma_tr) of the sites to
        sigma_a and sigma_s'.
    """
    effect = skin_tables().effects[person.condition]
    diffuse = _diffuse_reflectance(head, person, effect)
    sites = _sites(head, person, diffuse, effect, eta)
    effects = skin_tables().gloss_effects
    gloss = {
        "ancestry": effects.albedo[person.ancestry],
        "age": float(np.exp(effects.albedo_per_year * (person.age - MIDDLE_AGE))),
        "condition": effect.gloss,
    }
    bases = _bases(person, effect)
    albedo, fractions = _surface(head, person, effect)
    if person.bases:
        bases, fractions = _patches(head, person, person.bases)
    albedo = albedo * np.prod([*gloss.values()])
    return Skin(
        diffuse,
        albedo[:, None] * (fractions @ bases) / material_albedo,
        bases,
        gloss,
        _sigma_tr(head.vertices, sites),
        sites,
    )


def _diffuse_reflectance(
    head: Head, person: Person, effect: ConditionEffect
) -> Float64:
    """Group and site mean, moved along the melanin and haemoglobin axes; then hair."""
    tables = skin_tables()
    sites = tables.sites
    group = (person.ancestry, person.gender)
    m = head.membership
    weight = np.stack([m[site] for site in sites], axis=1) + 1e-6
    # everywhere else
    weight[:, sites.index("cheek")] += np.clip(1 - weight.sum(axis=1), 0, 1)
    weight[:, sites.index("cheek")] += m["lips"]
    log = (weight / weight.sum(axis=1, keepdims=True)) @ np.log(tables.mean[group])
    melanin, blood = _pigment(head, person)
    melanin = (1 - effect.even) * melanin
    blood = (1 - effect.even) * blood
    old = np.clip((person.age - 30) / 50, 0, 1)
    melanin += tables.spread[group] * person.melanin + 0.08 * old + effect.melanin
    blood += BLOOD_SPREAD * person.blood + effect.blood
    # blood shows less through melanin
    pale = float(np.clip(np.exp(log.mean(axis=0))[1] / 0.27, 0.25, 1))
    blood = blood + pale * (0.55 * m["lips"] + 0.10 * m["nose"] + 0.10 * m["eyelid"])
    melanin = (
        melanin + (0.30 - 0.18 * pale) * m["lips"] + (0.06 + 0.08 * old) * m["eyelid"]
    )
    colour = np.exp(
        log - np.outer(melanin, tables.melanin) - np.outer(blood, tables.haemoglobin)
    )
    return np.clip(colour * (1 - _hair(head, person)), 0.008, 0.95)


def _pigment(head: Head, person: Person) -> tuple[Float64, Float64]:
    """Melanin and blood of each vertex about the mean, log green: mottling, freckles,
    age spots, flushed cheeks.
    """
    rng = person.stream(2)
    p = head.vertices
    melanin = sum(
        (
            a * smooth_noise(p, w, rng=rng)
            for w, a in ((60, 0.03), (20, 0.03), (8, 0.03), (4, 0.025))
        ),
        0 * p[:, 0],
    )
    blood = 0.05 * smooth_noise(p, 35, rng=rng) + 0.03 * smooth_noise(p, 10, rng=rng)
    blood += 0.10 * head.membership["cheek"] * np.exp(-0.5 * ((p[:, 1] + 2) / 22) ** 2)
    old = np.clip((person.age - 40) / 40, 0, 1)
    spots = int(15 + 260 * person.freckles + 60 * old)
    size = rng.uniform(0.7, 1.4, spots) * (1 + 0.8 * old)
    depth = rng.uniform(0.15, 0.55, spots)
    share = (
        0.15
        + head.membership["cheek"]
        + head.membership["nose"]
        + 0.4 * head.membership["forehead"]
    )
    centre = p[rng.choice(len(p), spots, p=share / share.sum())] if len(p) else p
    dark = np.zeros(len(p))
    for near, c, s, d in zip(
        cKDTree(p).query_ball_point(centre, 3.5 * size),
        centre,
        size,
        depth,
        strict=True,
    ):
        spot = d * np.exp(-0.5 * ((p[near] - c) ** 2).sum(axis=1) / s**2)
        dark[near] = np.maximum(dark[near], spot)
    return melanin + dark, blood


def _hair(head: Head, person: Person) -> Float64:
    """Fraction of light (n, 3) that brows, lashes and beard stubble absorb."""
    rng = person.stream(3)
    m = head.membership
    strands = np.clip(1 + 0.35 * smooth_noise(head.vertices, 3.0, rng=rng), 0.2, 1.6)
    brow = np.clip(
        (0.62 if person.gender == "male" else 0.5) * m["brow"] * strands, 0, 0.85
    )
    lash = 0.6 * m.get("lash", 0 * brow)
    stubble = np.clip(0.45 * person.beard_density * m["beard"] * strands, 0, 0.75)
    keep = (1 - brow) * (1 - lash)
    return 1 - keep[:, None] * (1 - np.outer(stubble, [1.0, 0.95, 0.86]))


def _bases(person: Person, effect: ConditionEffect) -> Float64:
    """Fractions (BASES, k) of MATERIALS in each of a person's bases."""
    effects = skin_tables().gloss_effects
    second = np.add(
        effects.second[person.ancestry],
        np.multiply(effects.second_per_year, person.age - MIDDLE_AGE),
    )
    second += MIX_SPREAD * person.stream(7).standard_normal(2)
    second = np.clip(second, 0, 1)
    bases = np.eye(BASES, len(MATERIALS))
    bases[[0, 1], [0, 1]] -= second
    bases[[0, 1], [BASES, BASES + 1]] = second
    bases *= 1 - effect.film - effect.powder
    bases[:, -2:] += effect.film, effect.powder
    return bases


def materials_of(person: Person) -> tuple[str, ...]:
    """Names of the BRDFs of which a person's bases are mixtures."""
    return DISTINCT[: person.bases] if person.bases else MATERIALS


def _patches(head: Head, person: Person, count: int) -> tuple[Float64, Float64]:
    """Bases, each one of `count` BRDFs, and their fractions, 1 or 0, at the vertices: four
    BRDFs in a condition, of which two differ in conditions other than normal.
    """
    rng = person.stream(8)
    order = rng.permutation(count)
    if person.condition != "normal":
        order = np.roll(order, -2)
    order = order[:BASES]
    centres = rng.choice(head.vertices, PATCHES)
    patch = cKDTree(centres).query(head.vertices)[1]
    return np.eye(count)[order], np.eye(len(order))[patch % len(order)]


def _surface(
    head: Head, person: Person, effect: ConditionEffect
) -> tuple[Float64, Float64]:
    """Smooth specular albedo (n,) at normal incidence of the person without gloss factors,
    and fractions (n, BASES) of it.
    """
    rng = person.stream(4)
    p = head.vertices
    rows = skin_tables().gloss
    names = [name for name in rows if name in head.membership]
    member = np.stack([head.membership[name] for name in names], axis=1)
    rest = np.clip(1 - member.sum(axis=1), 0, 1)
    table = np.array([rows[name] for name in names])
    field = member @ table + np.outer(rest, rows["elsewhere"])
    field /= (member.sum(axis=1) + rest)[:, None]
    personal = rng.lognormal(0, 0.12, BASES)
    noise = [0.5 * smooth_noise(p, 30, rng=rng) for _ in range(BASES)]
    fractions = field[:, 1:] * np.exp(np.stack(noise, axis=1)) * personal
    fractions[:, SHARP] *= effect.sharp
    fractions /= fractions.sum(axis=1, keepdims=True)
    albedo = (
        field[:, 0] * (1 + 0.05 * smooth_noise(p, 25, rng=rng)) * rng.lognormal(0, 0.06)
    )
    return np.clip(albedo, 0.03, 0.06), fractions


def _sites(
    head: Head, person: Person, diffuse: Float64, effect: ConditionEffect, eta: float
) -> tuple[Site, ...]:
    """The probe's sites: sigma_tr about table 2, and the coefficients it and the local
    R_d imply (paper, section 9).
    """
    rng = person.stream(5)
    personal = person.stream(6).lognormal(0, 0.12)
    sites = []
    for name, mean in skin_tables().sigma_tr.items():
        local = rng.lognormal(0, 0.06) * rng.lognormal(0, 0.03, 3)
        vertex = _site_vertex(head, name)
        if vertex is None:
            continue
        near = ((head.vertices - head.vertices[vertex]) ** 2).sum(axis=1) < PATCH**2
        colour = diffuse[near].mean(axis=0)
        sigma_tr = np.clip(mean * personal * local * effect.translucency, 0.3, 3.0)
        s, _ = dipole_s(colour, eta=eta)
        sigma_a, sigma_s = (float64(x) for x in scattering_coefficients(s, sigma_tr))
        sites.append(
            Site(name, head.vertices[vertex], colour, sigma_tr, sigma_a, sigma_s)
        )
    return tuple(sites)


def _site_vertex(head: Head, name: str) -> int | None:
    """Vertex at the centre of a site: the landmark of the forehead, the left cheek, the
    front of the neck.
    """
    member = head.membership[name] > 0.5
    if name == "cheek":
        member &= head.vertices[:, 0] > 0
    if name == "neck":
        member &= (np.abs(head.vertices[:, 0]) < 20) & (head.normals[:, 2] > 0.3)
    if not member.any():
        return None
    ids = np.flatnonzero(member)
    middle = np.median(head.vertices[ids], axis=0)
    if name == "forehead" and "forehead_centre" in head.landmarks:
        middle = head.landmarks["forehead_centre"]
    return int(ids[((head.vertices[ids] - middle) ** 2).sum(axis=1).argmin()])


def _sigma_tr(points: Float64, sites: tuple[Site, ...]) -> Float64:
    """1/sigma_tr interpolated between the sites (Shepard); the cheek counts on both sides."""
    if not sites:
        return np.broadcast_to(skin_tables().sigma_tr["cheek"], (len(points), 3)).copy()
    anchors = [(s.position, s.sigma_tr) for s in sites]
    anchors += [
        (s.position * (-1, 1, 1), s.sigma_tr) for s in sites if s.name == "cheek"
    ]
    weight = np.stack(
        [1 / (((points - p) ** 2).sum(axis=1) + 25.0) for p, _ in anchors], axis=1
    )
    weight /= weight.sum(axis=1, keepdims=True)
    return 1 / (weight @ np.stack([1 / tr for _, tr in anchors]))
