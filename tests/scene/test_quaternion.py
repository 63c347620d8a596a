"""Quaternions, rotation matrices and poses, against SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.core.quaternions import multiply, rotation_matrix, unit_quaternions
from clsplat.scene.colmap import pose_matrix


def test_rotations_match_scipy(rng):
    quaternions = rng.normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    expected = Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(rotation_matrix(*quaternions.T), expected, atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(*quaternions[0]), expected[0], atol=1e-12)


def test_one_and_many_rotations_have_the_same_bits(rng):
    quaternions = rng.normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    one_by_one = np.stack([rotation_matrix(*quaternion) for quaternion in quaternions])
    np.testing.assert_array_equal(rotation_matrix(*quaternions.T), one_by_one)


def test_quaternions_of_rotations_are_the_same_up_to_sign(rng):
    quaternions = rng.normal(size=(50, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    result = unit_quaternions(rotation_matrix(*quaternions.T))
    np.testing.assert_allclose(np.abs((result * quaternions).sum(axis=1)), 1, atol=1e-12)
    np.testing.assert_array_equal(unit_quaternions(np.eye(3)), [1, 0, 0, 0])


def test_pose_accepts_a_quaternion_of_any_length():
    pose = pose_matrix((0, 3, 0, 0), (1, 2, 3))
    np.testing.assert_array_equal(pose, [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3]])


@pytest.mark.parametrize(
    ("quaternion", "translation"),
    [
        ((0, 0, 0, 0), (0, 0, 0)),
        ((float("nan"), 0, 0, 1), (0, 0, 0)),
        ((float("inf"), 0, 0, 1), (0, 0, 0)),
        ((1, 0, 0, 0), (0, float("nan"), 0)),
        ((1, 0, 0, 0), (0, 1e16, 0)),
        ((1, 0, 0), (0, 0, 0)),
        ((1, 0, 0, 0), (0, 0)),
    ],
)
def test_invalid_pose_is_refused(quaternion, translation):
    with pytest.raises(ValueError, match="expected finite numbers and a quaternion that is not zero"):
        pose_matrix(quaternion, translation)


def test_product_applies_rotations_in_order(rng):
    left, right = rng.normal(size=(2, 50, 4))
    matrices = [Rotation.from_quat(np.roll(quats, -1, axis=1)).as_matrix() for quats in (left, right)]
    left, right = (quats / np.linalg.norm(quats, axis=1, keepdims=True) for quats in (left, right))
    np.testing.assert_allclose(rotation_matrix(*multiply(left, right).T), matrices[0] @ matrices[1], atol=1e-12)
    np.testing.assert_array_equal(multiply(left[0], right), multiply(np.tile(left[0], (50, 1)), right))
    np.testing.assert_array_equal(multiply(left, right[0]), multiply(left, np.tile(right[0], (50, 1))))
