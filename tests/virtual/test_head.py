import numpy as np
import pytest
from scipy.spatial import cKDTree

from skindb.virtual.face import FaceShape, field, normals
from skindb.virtual.head import parametric_head
from skindb.virtual.person import Person, default_people, face_shape

LANDMARKS = {
    "forehead_centre",
    "forehead_right",
    "forehead_left",
    "brow_right",
    "brow_left",
    "nasion",
    "nose_tip",
    "subnasale",
    "ala_right",
    "ala_left",
    "eye_outer_right",
    "eye_inner_right",
    "eye_inner_left",
    "eye_outer_left",
    "mouth_corner_right",
    "mouth_corner_left",
    "lip_upper",
    "chin",
    "jaw_right",
    "jaw_left",
}
ON_SKIN = 1e-3  # mm: error of the Newton projection


@pytest.fixture(scope="module")
def head():
    return parametric_head(FaceShape(), spacing_mm=4.0)


def _boundary_edges(faces):
    edge = np.sort(
        np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1
    )
    unique, count = np.unique(edge, axis=0, return_counts=True)
    assert count.max() == 2
    return unique, unique[count == 1]


def test_parametric_head__is_a_disc_with_one_boundary_loop(head):
    edges, boundary = _boundary_edges(head.faces)
    assert len(head.vertices) - len(edges) + len(head.faces) == 1
    following = {}
    for a, b in boundary:
        following.setdefault(a, []).append(b)
        following.setdefault(b, []).append(a)
    assert all(len(v) == 2 for v in following.values())
    seen = set()
    at = boundary[0, 0]
    before = -1
    while at not in seen:
        seen.add(at)
        at, before = next(v for v in following[at] if v != before), at
    assert len(seen) == len(boundary)


@pytest.mark.slow
@pytest.mark.parametrize(
    "person",
    [p for p in default_people() if p.condition == "normal"],
    ids=lambda p: p.subject,
)
def test_parametric_head__every_default_person_has_sound_triangles(person):
    head = parametric_head(face_shape(person), spacing_mm=4.0)
    a, b, c = (head.vertices[head.faces[:, i]] for i in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1) / 2
    mean = head.normals[head.faces].sum(axis=1)
    assert area.min() > 0.02  # mm2
    # no triangle is turned against the true surface (coarse sampling: folds of the lips
    # are rounded off)
    assert ((cross * mean).sum(axis=1) > 0).mean() > 0.999
    assert np.abs(field(head.vertices, face_shape(person))).max() < ON_SKIN


@pytest.mark.slow
def test_normals__agree_with_a_finer_sampling_of_the_surface(head):
    fine = parametric_head(FaceShape(), spacing_mm=1.5)
    a, b, c = (fine.vertices[fine.faces[:, i]] for i in range(3))
    facet = np.cross(b - a, c - a)
    summed = np.zeros_like(fine.vertices)
    for i in range(3):
        np.add.at(summed, fine.faces[:, i], facet)
    summed /= np.linalg.norm(summed, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((summed * fine.normals).sum(axis=1), -1, 1)))
    assert np.median(angle) < 0.5
    # creases: facets of 1.5 mm cannot follow them
    assert np.quantile(angle, 0.95) < 4.0


def test_normals__are_the_gradient(head):
    shape = FaceShape()
    eps = 1e-3
    outside = field(head.vertices + eps * head.normals, shape)
    inside = field(head.vertices - eps * head.normals, shape)
    assert (outside > inside).all()
    np.testing.assert_allclose(
        np.linalg.norm(normals(head.vertices, shape), axis=1), 1, atol=1e-12
    )


def test_parametric_head__landmarks_have_the_known_names_and_lie_on_the_skin(head):
    assert set(head.landmarks) == LANDMARKS
    points = np.array(list(head.landmarks.values()))
    assert np.abs(field(points, FaceShape())).max() < ON_SKIN
    # inside the part that is sampled
    assert cKDTree(head.vertices).query(points)[0].max() < 5.0
    mark = head.landmarks
    assert (
        mark["eye_outer_left"][0]
        > mark["eye_inner_left"][0]
        > 0
        > mark["eye_inner_right"][0]
    )
    heights = [
        mark[n][1]
        for n in (
            "forehead_centre",
            "nasion",
            "nose_tip",
            "subnasale",
            "lip_upper",
            "chin",
        )
    ]
    assert heights == sorted(heights, reverse=True)
    assert mark["nose_tip"][2] == max(p[2] for p in mark.values())


def test_parametric_head__landmarks_lie_in_their_regions(head):
    tree = cKDTree(head.vertices)
    for name, region in (
        ("nose_tip", "nose"),
        ("chin", "chin"),
        ("forehead_centre", "forehead"),
        ("lip_upper", "lips"),
    ):
        assert head.membership[region][tree.query(head.landmarks[name])[1]] > 0.5


def test_parametric_head__regions_are_soft_and_none_is_empty(head):
    for name, values in head.membership.items():
        assert values.min() >= 0, name
        assert values.max() <= 1, name
        if name not in ("brow", "lash"):  # thinner than this sampling
            assert head.region(name).sum() > 5, name
    assert not (head.region("lips") & head.region("nose")).any()
    assert not (head.region("beard") & head.region("forehead")).any()


def test_parametric_head__two_samplings_are_the_same_surface(head):
    scan = parametric_head(FaceShape(), spacing_mm=5.0, jitter=0.25, seed=3)
    assert np.abs(field(scan.vertices, FaceShape())).max() < ON_SKIN
    inner = cKDTree(head.vertices).query(scan.vertices)[0]
    assert np.median(inner) > 0.5  # no shared vertices


def test_face_shape__differs_between_people_and_not_between_conditions():
    first = Person("A", 30, "female", "european", 1)
    second = Person("B", 30, "female", "european", 2)
    assert face_shape(first) == face_shape(
        Person("A", 30, "female", "european", 1, condition="lotion")
    )
    assert face_shape(first) != face_shape(second)


@pytest.mark.parametrize("key", ["gender", "ancestry", "condition"])
def test_person__rejects_unknown_words(key):
    with pytest.raises(ValueError, match=key):
        Person(
            **(
                {
                    "subject": "A",
                    "age": 30,
                    "gender": "male",
                    "ancestry": "african",
                    "seed": 1,
                }
                | {key: "unknown"}
            )
        )


def test_default_people__are_eight_takes_of_six_subjects():
    people = default_people()
    assert len({p.take for p in people}) == 8
    assert len({p.subject for p in people}) == 6
    assert {"V001", "V001.lotion", "V001.powder"} <= {p.take for p in people}


def test_parametric_head__no_vertex_leaves_the_skin_in_a_crease():
    """Seen in a cohort of 87: one vertex of this head was 0.8 m away."""
    person = Person(
        "P075",
        68.0,
        "male",
        "south_asian",
        1075,
        freckles=0.5,
        melanin=0.5435021410946412,
        blood=0.38540485500243327,
        beard_density=0.14826078548974328,
        fullness=0.6932476719384093,
    )
    shape = face_shape(person)
    seed = int(np.random.default_rng([person.seed, True]).integers(2**31))
    head = parametric_head(shape, spacing_mm=3.6, jitter=0.25, seed=seed)
    assert np.abs(field(head.vertices, shape)).max() < 0.02  # mm; _settle stops at 0.01
