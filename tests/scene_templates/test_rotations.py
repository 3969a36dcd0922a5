"""Rotations are rotations, uniform ones are uniform, and Euler angles compose as stated."""

import math

import numpy as np

from scene_templates.rotations import rotated, rotation_xyz, uniform_rotation


def test_uniform_rotations_are_proper() -> None:
    rng = np.random.default_rng(0)
    matrices = np.stack([uniform_rotation(rng) for _ in range(200)])
    gram = np.einsum("nij,nkj->nik", matrices, matrices)
    # A handful of float64 operations: a few units of 2e-16.
    assert np.abs(gram - np.eye(3)).max() < 1e-14
    assert np.abs(np.linalg.det(matrices) - 1).max() < 1e-14


def test_uniform_rotations_follow_the_haar_measure() -> None:
    """The turning angle has density (1 - cos a) / pi, hence the mean pi/2 + 2/pi."""
    rng = np.random.default_rng(1)
    matrices = np.stack([uniform_rotation(rng) for _ in range(20000)])
    angles = np.arccos(np.clip((np.trace(matrices, axis1=1, axis2=2) - 1) / 2, -1, 1))
    standard_error = angles.std() / math.sqrt(len(angles))
    # Five standard errors: one false alarm in two million seeds.
    assert abs(angles.mean() - (math.pi / 2 + 2 / math.pi)) < 5 * standard_error
    # The scalar part w of a uniform unit quaternion has E[w^4] = 1/8; trace = 4 w^2 - 1. A
    # quaternion normalised from a cube instead of a Gaussian fails here and nowhere else.
    fourth = np.square((np.trace(matrices, axis1=1, axis2=2) + 1) / 4)
    assert abs(fourth.mean() - 1 / 8) < 5 * fourth.std() / math.sqrt(len(fourth))
    # Each entry has mean 0 and variance 1/3 on SO(3); nine entries share the bound.
    assert np.abs(matrices.mean(axis=0)).max() < 5 * math.sqrt(1 / 3 / len(matrices))


def test_euler_angles_turn_about_x_then_y_then_z() -> None:
    rng = np.random.default_rng(2)
    for angles in rng.uniform(-180, 180, size=(50, 3)):
        x, y, z = (rotation_xyz(np.where(np.arange(3) == axis, angles, 0)) for axis in range(3))
        assert np.abs(rotation_xyz(angles) - z @ y @ x).max() < 1e-14


def test_a_quarter_turn_about_z_brings_x_to_y() -> None:
    turned = rotated(np.array([[1.0, 0, 0]]), rotation_xyz([0, 0, 90]))
    assert np.abs(turned - [[0, 1, 0]]).max() < 1e-15
