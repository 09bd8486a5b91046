"""Places recognized by what a camera sees: landmarks with descriptors, and the pose among them."""

from dataclasses import replace

import numpy as np
import pytest
from test_atlas_maps import S, map_of

from sceneslam.atlas.lasting.map_files import load_map_files, save_map_files
from sceneslam.atlas.lasting.prune import prune
from sceneslam.atlas.mapper import Mapper
from sceneslam.atlas.places.floor_plan import join
from sceneslam.atlas.places.localizer import LocalizationEvent, Look, MapLocalizer
from sceneslam.atlas.submaps.collector import Known
from sceneslam.evaluation.association import interpolated
from sceneslam.scans.key_scan import KeyScan
from sceneslam.sources.tum_rgbd import TumRgbd
from sceneslam.types import se3
from sceneslam.types.rig import Camera, Rig, Sensor
from sceneslam.views.placed_views import Sighting
from sceneslam.views.view import Landmarks, LandmarkView, PlacedView, depth_noise_m
from sceneslam.views.view_finder import ViewFinder

CAMERA = Camera(size_wh=(640, 480), fx=500.0, fy=500.0, cx=320.0, cy=240.0)
MOUNT = CAMERA.T_base_cam
HERE, ELSEWHERE = se3.from_xy_yaw(2.0, 1.0, 0.4), se3.from_xy_yaw(-9.0, 4.0, 2.0)


def landmarks_at(points_base, descriptors):
    """Landmarks that a depth camera measured."""
    points = se3.apply(se3.inverse(MOUNT), points_base).astype(np.float32)
    noise_m = depth_noise_m(np.linalg.norm(points, axis=1)).astype(np.float32)
    return Landmarks(points_cam=points, deviation_m=noise_m, descriptors=descriptors)


def points_of(landmarks):
    """The points (N, 3) [m] in base."""
    return se3.apply(MOUNT, landmarks.points_cam.astype(float))


def base_of(found):
    """Where base is, by a sighting."""
    return found.T_map_cam @ se3.inverse(MOUNT)


def place(seed, count=200):
    """Landmarks of a wall with furniture, 2 to 4 m ahead of base, with random descriptors."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([2.0, -1.2, -0.8], [4.0, 1.2, 0.8], (count, 3))
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    return landmarks_at(points, descriptors)


def view_of(landmarks, T_seen_base, *, noise_px=0.5, shown=1.0, farther_m=0.0, shear_rad=0.0):
    """What the camera sees of a place from a pose in it, and other things."""
    rng = np.random.default_rng(7)
    points_cam = se3.apply(se3.inverse(T_seen_base @ MOUNT), points_of(landmarks))
    is_shown = rng.random(len(points_cam)) < shown
    rays = points_cam[:, :2] / points_cam[:, 2:]
    rays += rng.normal(0, noise_px / 500.0, rays.shape)
    descriptors = landmarks.descriptors.copy()
    descriptors[:, 0] ^= rng.integers(0, 256, len(descriptors), dtype=np.uint8)  # a few bits differ
    descriptors[~is_shown] = rng.integers(0, 256, ((~is_shown).sum(), 32), dtype=np.uint8)
    depth_m = (points_cam[:, 2] + farther_m).astype(np.float32)
    return LandmarkView(
        rays=rays.astype(np.float32),
        descriptors=descriptors,
        depth_m=depth_m,
        shear_rad=shear_rad,
    )


def finder(*placed):
    """A finder of landmarks that were seen from poses of base."""
    return ViewFinder(CAMERA, [(T @ MOUNT, landmarks) for T, landmarks in placed])


ASIDE = se3.exp(np.array([0.3, -0.2, 0.05, 0.02, -0.03, 0.1]))


def test_a_view_is_recognized_with_the_pose_it_was_seen_from():
    known = finder((HERE, place(1)), (ELSEWHERE, place(2)))
    for T_map_seen, seed in ((HERE, 1), (ELSEWHERE, 2)):
        found = known.recognize(view_of(place(seed), ASIDE))
        off = se3.inverse(T_map_seen @ ASIDE) @ base_of(found)
        assert np.linalg.norm(off[:3, 3]) < 0.01 and se3.rotation_angle_rad(off) < 0.003
        assert found.matches > 150
        deviations = np.sqrt(np.diag(found.covariance))
        assert (deviations[:3] >= 0.01).all() and (deviations[:3] < 0.015).all()
    assert known.recognize(view_of(place(3), ASIDE)) is None


def test_the_pose_is_by_the_landmarks_of_all_views_of_a_place():
    off_m = []
    for seed in range(5):
        rng, true = np.random.default_rng(seed), place(seed, 400)
        parts = []
        for rows in np.array_split(rng.permutation(400), 4):  # each view has a quarter
            T_here_seen = se3.exp(rng.normal(0, 0.2, 6))
            points = se3.apply(se3.inverse(T_here_seen), points_of(true)[rows])
            points += rng.normal(0, 0.01, points.shape)  # as depth cameras measure
            part = landmarks_at(points, true.descriptors[rows].copy())
            parts.append((HERE @ T_here_seen, part))
        view, T_base_map = view_of(true, ASIDE), se3.inverse(HERE @ ASIDE)
        found = [known.recognize(view) for known in (finder(parts[0]), finder(*parts))]
        off_m.append([np.linalg.norm((T_base_map @ base_of(one))[:3, 3]) for one in found])
        assert found[1].matches > 2 * found[0].matches
    by_one, by_all = np.sqrt((np.array(off_m) ** 2).mean(axis=0))
    assert by_all < 0.75 * by_one  # a quarter of the variance, beside the image's noise


def test_of_landmarks_in_a_small_patch_depths_tell_the_heading():
    off_rad = []
    for seed in range(10):
        rng, patch = np.random.default_rng(seed), place(seed)
        patch.points_cam[:] = rng.uniform([-0.2, -0.2, 2.5], [0.2, 0.2, 2.6], (200, 3))
        view = view_of(patch, ASIDE, noise_px=1.5)
        precise = view.depth_m + rng.normal(0, 0.002, 200).astype(np.float32)
        noisy = view.depth_m + rng.normal(0, 0.02, 200).astype(np.float32)
        found = [
            finder((HERE, patch)).recognize(replace(view, depth_m=depth_m))
            for depth_m in (precise, noisy)
        ]
        off = [se3.inverse(HERE @ ASIDE) @ base_of(one) for one in found]
        off_rad.append([abs(se3.yaw_rad(T)) for T in off])
    by_precise, by_noisy = np.sqrt((np.array(off_rad) ** 2).mean(axis=0))
    assert by_precise < 0.003  # 0.002 m of a patch of 0.4 m, over 200 landmarks
    assert by_precise < 0.5 * by_noisy


def test_a_place_is_found_from_afar():
    far = ASIDE @ se3.from_xy_yaw(-3.0, 0.0, 0.0)  # where no view of the map was taken
    found = finder((HERE, place(1))).recognize(view_of(place(1), far))
    assert np.linalg.norm((se3.inverse(HERE @ far) @ base_of(found))[:3, 3]) < 0.03


def test_two_places_that_look_alike_are_not_recognized():
    assert (
        finder((HERE, place(1)), (ELSEWHERE, place(1))).recognize(view_of(place(1), ASIDE)) is None
    )
    near = HERE @ se3.exp(np.array([0.01, 0, 0, 0, 0, 0]))  # one place, kept twice
    assert (
        finder((HERE, place(1)), (near, place(1))).recognize(view_of(place(1), ASIDE)) is not None
    )


@pytest.mark.parametrize(
    ("doubtful", "sound"),
    [
        ({"shown": 0.1}, {"shown": 0.5}),  # too few matches
        ({"farther_m": 0.4}, {"farther_m": 0.1}),  # a picture of the place, on another wall
        ({"shear_rad": 0.035}, {"shear_rad": 0.025}),  # seen in a fast turn
    ],
)
def test_what_is_doubtful_is_not_recognized(doubtful, sound):
    known = finder((HERE, place(1)))
    assert known.recognize(view_of(place(1), ASIDE, **doubtful)) is None
    assert known.recognize(view_of(place(1), ASIDE, **sound)) is not None


def test_a_poster_that_hangs_elsewhere_now_is_not_its_old_place():
    wall, seen = place(1), view_of(place(1), ASIDE)
    poster = landmarks_at(points_of(wall)[:40], wall.descriptors[:40])
    rest = place(2, 600)  # that was around it
    around = landmarks_at(
        np.concatenate([points_of(poster), points_of(rest)]),
        np.concatenate([poster.descriptors, rest.descriptors]),
    )
    assert finder((HERE, poster)).recognize(seen) is not None
    assert finder((HERE, around)).recognize(seen) is None
    found = finder((HERE, around)).find(seen, HERE @ MOUNT, half_m=0.5, half_rad=0.2)  # it is there
    assert np.linalg.norm((se3.inverse(HERE @ ASIDE) @ base_of(found))[:3, 3]) < 0.02


def test_a_noisy_depth_camera_is_found_by_landmarks_that_are_known_better():
    """As those of a map that a camera without depth made, from two sides."""
    rng, precise = np.random.default_rng(1), place(1)
    precise = replace(precise, deviation_m=np.full(200, 0.005, np.float32))
    view = view_of(precise, ASIDE)
    noisy = view.depth_m + rng.normal(0, depth_noise_m(view.depth_m)).astype(np.float32)
    view, known = replace(view, depth_m=noisy), finder((HERE, precise))
    for found in (known.recognize(view), known.find(view, HERE @ MOUNT, half_m=0.6, half_rad=0.2)):
        assert np.linalg.norm((se3.inverse(HERE @ ASIDE) @ base_of(found))[:3, 3]) < 0.01


def far_off(landmarks, ratio, rows):
    """Landmarks some of which lie a share of their distance too far away."""
    points = landmarks.points_cam.copy()
    points[rows] *= 1.0 + ratio
    deviation_m = landmarks.deviation_m.copy()
    deviation_m[rows] = ratio * np.linalg.norm(points[rows], axis=1)
    return replace(landmarks, points_cam=points), deviation_m


def test_corners_of_uncertain_distance_count_for_less_from_the_side():
    off_m = {True: [], False: []}
    for seed in range(5):
        wrong, deviation_m = far_off(place(seed), 0.1, np.arange(0, 120))
        view = replace(view_of(place(seed), ASIDE), depth_m=np.zeros(200, np.float32))
        for is_stated in (True, False):
            known = replace(wrong, deviation_m=deviation_m) if is_stated else wrong
            found = finder((HERE, known)).find(view, HERE @ MOUNT, half_m=0.6, half_rad=0.3)
            off = se3.inverse(HERE @ ASIDE) @ base_of(found)
            off_m[is_stated].append(np.linalg.norm(off[:3, 3]))
    assert np.median(off_m[True]) < 0.5 * np.median(off_m[False])


def test_views_that_face_elsewhere_do_not_crowd_out_the_one_that_shows_the_place():
    turned = [
        (HERE @ se3.from_xy_yaw(0.01 * index, 0.0, np.pi), place(50 + index)) for index in range(15)
    ]
    beside = HERE @ se3.from_xy_yaw(-0.3, 0.0, 0.0)
    seen = view_of(place(1), se3.from_xy_yaw(0.3, 0.0, 0.0))
    known = finder(*turned, (beside, place(1)))
    found = known.find(seen, HERE @ MOUNT, half_m=0.2, half_rad=0.1)
    assert np.linalg.norm((se3.inverse(HERE) @ base_of(found))[:3, 3]) < 0.02


# A run that looks for itself by them.


class Eyes:
    """A finder that answers as it is told."""

    def __init__(self):
        self.answer, self.camera = None, CAMERA

    def find(self, view, expected, *, half_m, half_rad):
        return self.recognize(view)

    def recognize(self, view, around=None):
        return self.answer and Sighting(
            T_map_cam=self.answer[0] @ MOUNT, covariance=1e-4 * np.eye(6), matches=50
        )


def looking_by(eyes):
    return MapLocalizer(join([]), eyes)


def look(second, T_run_base=HERE):
    return Look(
        stamp_ns=round(second * S), T_run_base=T_run_base, view=view_of(place(1), se3.identity())
    )


def test_a_run_is_located_where_two_views_in_a_row_agree():
    eyes = Eyes()
    own = looking_by(eyes)
    assert own.wants_view(look(0.0)) and own.compare([look(0.0)]) is LocalizationEvent.NOTHING
    assert not own.wants_view(look(0.19)) and own.wants_view(look(0.2))
    eyes.answer = (ELSEWHERE,)
    assert own.compare([look(0.2)]) is LocalizationEvent.NOTHING
    eyes.answer = (ELSEWHERE @ se3.from_xy_yaw(0.11, 0.0, 0.0),)
    assert own.compare([look(0.4)]) is LocalizationEvent.NOTHING  # elsewhere
    eyes.answer = (ELSEWHERE @ se3.from_xy_yaw(0.11, 0.0, 0.04),)
    assert own.compare([look(0.6)]) is LocalizationEvent.FOUND
    middle = ELSEWHERE @ se3.from_xy_yaw(0.11, 0.0, 0.02)  # of both views
    np.testing.assert_allclose(own.T_map_run @ HERE, middle, atol=1e-12)
    (fix,) = own.fixes
    assert fix.stamp_ns == round(0.6 * S)
    np.testing.assert_allclose(fix.covariance, 1e-4 * np.eye(6), atol=1e-8)


def test_a_located_run_is_fixed_by_views_and_withdrawn_by_three_that_contradict():
    eyes = Eyes()
    own = looking_by(eyes)
    eyes.answer = (ELSEWHERE,)
    assert [own.compare([look(t)]) for t in (0.0, 0.2)][-1] is LocalizationEvent.FOUND
    turned = HERE @ se3.from_xy_yaw(0.0, 0.0, 0.31)
    assert own.wants_view(look(1.3, turned)) and not own.wants_view(look(1.1, turned))
    assert not own.wants_view(look(1.3, HERE @ se3.from_xy_yaw(0.3, 0.0, 0.29)))
    eyes.answer = (ELSEWHERE @ se3.from_xy_yaw(0.1, 0.0, 0.31),)
    assert own.compare([look(2.0, turned)]) is LocalizationEvent.FIXED
    eyes.answer = None
    assert own.compare([look(3.0, turned)]) is LocalizationEvent.NOTHING
    eyes.answer = (ELSEWHERE @ se3.from_xy_yaw(3.0, 0.0, 0.0),)
    said = [own.compare([look(second, turned)]) for second in (4, 5, 6)]
    nothing = LocalizationEvent.NOTHING
    assert said == [nothing, nothing, LocalizationEvent.WITHDRAWN]
    assert own.T_map_run is None


def kept_map():
    return replace(
        map_of(join([]), join([]), nodes=[[0, 0, 0], [5, 0, 1]], pieces=[0, 1]),
        submaps=tuple(
            replace(
                one,
                views=(
                    PlacedView(stamp_ns=7, T_submap_cam=HERE, landmarks=place(1)),
                    PlacedView(stamp_ns=8, T_submap_cam=ASIDE, landmarks=place(2, 50)),
                )[: 2 - number],
            )
            for number, one in enumerate(map_of(join([]), join([])).submaps)
        ),
    )


def test_views_are_saved_with_their_submaps(tmp_path):
    saved = kept_map()
    save_map_files(saved, tmp_path)
    found = load_map_files(tmp_path)
    assert [len(one.views) for one in found.submaps] == [2, 1]
    for one, other in zip(found.submaps, saved.submaps, strict=True):
        for view, kept in zip(one.views, other.views, strict=True):
            assert view.stamp_ns == kept.stamp_ns
            np.testing.assert_array_equal(view.T_submap_cam, kept.T_submap_cam)
            for name in ("points_cam", "descriptors"):
                expected = getattr(kept.landmarks, name)
                np.testing.assert_array_equal(getattr(view.landmarks, name), expected)
    (second,) = found.views(1)
    np.testing.assert_allclose(second[0], se3.from_xy_yaw(5, 0, 1) @ HERE, atol=1e-12)
    assert len(found.views(0)) == 2


@pytest.mark.parametrize(
    ("folder", "camera", "scale"),
    [
        ("tum_fr1_rpy", dict.fromkeys(("fx", "fy", "cx", "cy", "distortion")), 5000.0),
        (
            "7scenes_redkitchen",
            {"fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0, "distortion": None},
            1000.0,
        ),
    ],
)
def test_a_camera_held_by_hand_finds_itself_in_the_map_of_the_first_half(
    shared_data, folder, camera, scale
):
    source = TumRgbd(str(shared_data / folder), camera, scale, [0.3, 8.0], 0.02)
    truth = source.ground_truth().trajectory
    observations = list(source)
    middle, saved, starts, events = len(observations) // 2, None, [], []
    for part in (observations[:middle], observations[middle : middle + 100]):
        stamps_ns = np.array([one.stamp_ns for one in part])
        known = stamps_ns <= truth.stamps_ns[-1]
        poses = dict(
            zip(
                stamps_ns[known].tolist(),
                interpolated(truth, stamps_ns[known]).T_world_base,
                strict=True,
            )
        )
        starts.append(poses[part[0].stamp_ns])
        T_run_gt = se3.inverse(starts[-1])
        path = lambda ns, poses=poses, T=T_run_gt: T @ poses[ns]  # noqa: E731
        mapper = Mapper(
            source.rig,
            known=lambda ns, path=path: Known(
                T_map_base=path(ns), session=0, module="a", covariance=None
            ),
            note=lambda event, ns, **fields: events.append((event, fields)),
            loaded=saved,
            keeps_views=True,
        )
        for one in part:
            if one.stamp_ns in poses:
                mapper.observe(one, None)
        located = mapper.T_map_run
        mapper.finish(path, [])
        saved = mapper.saved()
    assert [event for event, _ in events[:1]] == ["relocalized"]
    assert events[0][1]["after_s"] < 1.5  # 1.07 with a hand that turns fast, 0.2
    off = se3.inverse(se3.inverse(starts[0]) @ starts[1]) @ located
    # In a fast turn, whose rows are read one after the other, at first by 3 degrees.
    assert np.linalg.norm(off[:3, 3]) < 0.05 and se3.rotation_angle_rad(off) < 0.06
    assert (saved.pieces == 0).all()


def test_a_map_of_views_alone_serves_robots_that_see_walls_too():
    eyes = Eyes()
    own = looking_by(eyes)
    scan = KeyScan(stamp_ns=0, points=np.ones((5, 2), np.float32), origin=np.zeros(2))
    seen_too = [replace(look(second), scan=scan) for second in (0.0, 0.2, 2.0, 4.0)]
    assert not own.is_due(seen_too[0])
    eyes.answer = (ELSEWHERE,)
    said = [own.compare([one]) for one in (*seen_too[:3], replace(seen_too[3], view=None))]
    nothing, found, fixed = list(LocalizationEvent)[:3]
    assert said == [nothing, found, fixed, nothing]


def test_a_robot_without_a_camera_is_not_found_in_a_map_of_views_alone():
    rig = Rig(sensors=frozenset({Sensor.ODOMETRY}))
    mapper = Mapper(rig, known=lambda ns: None, note=lambda *_, **__: None, loaded=kept_map())
    assert not mapper.is_found
    assert Mapper(rig, known=lambda ns: None, note=lambda *_, **__: None).is_found


@pytest.mark.parametrize(("away_m", "turn_rad", "left"), [(0.4, 0.3, 1), (0.6, 0, 2), (0, 0.5, 2)])
def test_a_submap_goes_when_a_later_one_has_a_view_near_each_of_its(away_m, turn_rad, left):
    view = kept_map().submaps[1].views[0]
    beside = replace(view, T_submap_cam=view.T_submap_cam @ se3.from_xy_yaw(0.0, away_m, turn_rad))
    empty = map_of(join([]), join([]))
    submaps = [
        replace(one, views=(seen,)) for one, seen in zip(empty.submaps, (view, beside), strict=True)
    ]
    assert len(prune(replace(empty, submaps=tuple(submaps))).submaps) == left
    assert len(prune(replace(empty, submaps=(submaps[0], empty.submaps[1]))).submaps) == 2


def test_a_loaded_map_is_searched_near_the_expected_pose_first():
    """Where the run was located, a place far away that looks the same is no contradiction."""
    known = finder((HERE, place(1)), (ELSEWHERE, place(1)))
    view = view_of(place(1), ASIDE)
    assert known.recognize(view) is None
    found = known.recognize(view, ELSEWHERE @ MOUNT)
    off = se3.inverse(ELSEWHERE @ ASIDE) @ base_of(found)
    assert np.linalg.norm(off[:3, 3]) < 0.01
    assert known.recognize(view, se3.from_xy_yaw(50.0, 0.0, 0.0) @ MOUNT) is None
