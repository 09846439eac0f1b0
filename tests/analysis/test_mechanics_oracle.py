"""The chain's mechanics against pinocchio, which knows bodies and joints but none of our names."""

from __future__ import annotations

import numpy as np
import pytest

from analysis.regression.rows import parameters_of
from analysis.terms import baseline, make
from analysis.terms.base import Used, equation
from analysis.terms.mechanics import chain_matrix, mass_matrix
from analysis.terms.sine_cosine import sine_cosine
from hil_sim.plant.kernel import angular
from hil_sim.plant.kernel_data import JOINT
from hil_sim.plant.tables import inertia_matrix
from rig.model.rig import Rig
from tests.analysis.test_terms import chain_rig, signals_of
from tests.studies.machines.bodies import Body, chain_parameters

pin = pytest.importorskip("pinocchio", reason="the independent oracle, a development dependency")

Array = np.ndarray
GRAVITY = 9.8
FRICTION = (50.0, 5.0, 2.0, 1.0)


class Chain:
    """A chain of random bodies, and the same chain in pinocchio."""

    def __init__(self, joints: int, rng: np.random.Generator) -> None:
        self.bodies = [
            Body(
                length=rng.uniform(0.2, 0.7),
                mass=rng.uniform(0.5, 9.0),
                centre=rng.uniform(-0.1, 0.5),
                inertia=rng.uniform(0.01, 0.5),
            )
            for _ in range(joints)
        ]
        self.model = pin.Model()
        self.model.gravity.linear = np.array([0.0, -GRAVITY, 0.0])
        # The x axis of every link runs along it; at q = 0 the first hangs straight down.
        place = pin.SE3(pin.utils.rpyToMatrix(0.0, 0.0, -np.pi / 2), np.zeros(3))
        parent = 0
        for number, body in enumerate(self.bodies):
            parent = self.model.addJoint(parent, pin.JointModelRZ(), place, f"joint{number + 1}")
            # Beside the plane of motion a body may be where it likes and turn as it likes.
            aside = np.array([body.centre, 0.0, rng.uniform(-0.2, 0.2)])
            self.model.appendBodyToJoint(
                parent,
                pin.Inertia(body.mass, aside, _tensor(body.inertia, rng)),
                pin.SE3.Identity(),
            )
            place = pin.SE3(np.eye(3), np.array([body.length, 0.0, rng.uniform(-0.1, 0.1)]))
        self.data = self.model.createData()


def _tensor(about_z: float, rng: np.random.Generator) -> Array:
    """A rotational inertia with this about z and anything physical about the others."""
    spread = rng.uniform(0.1, 0.9, 2) * about_z
    return np.diag([0.6 * about_z + 0.1 * spread[0], 0.6 * about_z + 0.1 * spread[1], about_z])


@pytest.fixture(params=[1, 2, 3, 4])
def joints(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def chain(joints: int) -> Chain:
    return Chain(joints, np.random.default_rng(10 + joints))


def _motion(joints: int, samples: int = 40) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(joints)
    return tuple(rng.uniform(-scale, scale, (samples, joints)) for scale in (np.pi, 3.0, 20.0))  # type: ignore[return-value]


def test_the_regressor_times_the_bodies_parameters_is_the_inverse_dynamics(
    chain: Chain, joints: int, rig: Rig
) -> None:
    q, qd, qdd = _motion(joints)
    described = chain_rig(rig, joints)
    signals = signals_of(described, q, qd, qdd, np.random.default_rng(0))
    values = chain_parameters(chain.bodies)
    values |= {f"Fv{i + 1}": FRICTION[i] for i in range(joints)}
    used = tuple(Used(term) for term in baseline())
    names = parameters_of(described, used, "mechanical")
    assert set(names) == set(values)
    ours = np.zeros_like(q)
    for term in used:
        for i in range(joints):
            for name, column in (
                term.term.columns(described, signals, ()).get(equation("torque", i), {}).items()
            ):
                ours[:, i] += column * values[name]
    theirs = np.array(
        [pin.rnea(chain.model, chain.data, *row) for row in zip(q, qd, qdd, strict=True)]
    )
    theirs += qd * np.array(FRICTION[:joints])
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def test_the_mass_matrix_is_the_composite_rigid_bodies(chain: Chain, joints: int) -> None:
    R = chain_matrix(chain_parameters(chain.bodies), joints)
    for q in _motion(joints)[0]:
        theirs = np.array(pin.crba(chain.model, chain.data, q))
        np.testing.assert_allclose(mass_matrix(R, q), theirs, rtol=1e-10, atol=1e-10)


def test_at_rest_only_gravity_is_left(chain: Chain, joints: int) -> None:
    W = np.array([chain_parameters(chain.bodies)[f"W{i + 1}"] for i in range(joints)])
    for q in _motion(joints)[0]:
        carried = (W * GRAVITY * np.sin(np.cumsum(q)))[::-1].cumsum()[::-1]
        theirs = pin.computeGeneralizedGravity(chain.model, chain.data, q)
        np.testing.assert_allclose(carried, theirs, rtol=1e-10, atol=1e-10)


def test_the_simulated_acceleration_is_the_forward_dynamics(
    chain: Chain, joints: int, rig: Rig
) -> None:
    """The compiled kernels' own route: M and torques of the integrator, without friction."""
    described = chain_rig(rig, joints)
    values = chain_parameters(chain.bodies)
    bench, hidden = np.zeros(4), np.zeros(0)
    for q, qd, _ in zip(*_motion(joints), strict=True):
        x, out, M = np.zeros((11, joints)), np.zeros((5, joints)), np.zeros((joints, joints))
        x[0], x[1], x[2] = q, qd, np.cumsum(q)
        for term in (make("inertia"), make("gravity")):
            par = term.pack(described, values, ())
            term.kernel.function(1, bench, x, hidden, par, out, M, hidden)
        theirs = pin.aba(chain.model, chain.data, q, qd, np.zeros(joints))
        np.testing.assert_allclose(np.linalg.solve(M, out[0]), theirs, rtol=1e-8, atol=1e-8)


def test_the_plants_own_mechanics_agree_with_the_oracle(chain: Chain, joints: int) -> None:
    """The simulated bench is written separately; it must know the same bodies."""
    values = chain_parameters(chain.bodies)
    inertia = inertia_matrix(values, joints)
    table = np.zeros(joints, JOINT)
    table["weight"] = [GRAVITY * values[f"W{i + 1}"] for i in range(joints)]
    for q, qd, torque in zip(*_motion(joints), strict=True):
        theta, absolute = np.cumsum(q), torque.copy()
        angular(
            np.stack((np.sin(theta), np.cos(theta))), absolute, np.cumsum(qd), table, inertia,
            np.zeros((joints, joints)),
        )  # fmt: skip
        theirs = np.cumsum(pin.aba(chain.model, chain.data, q, qd, torque))
        np.testing.assert_allclose(absolute, theirs, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("largest", [1e-3, 1.0, 100.0, 1e6])
def test_the_kernels_sine_and_cosine_are_the_librarys(largest: float) -> None:
    angles = np.random.default_rng(0).uniform(-largest, largest, 2000)
    own = np.array([sine_cosine(angle) for angle in angles])
    np.testing.assert_allclose(own, np.column_stack((np.sin(angles), np.cos(angles))), atol=5e-16)
