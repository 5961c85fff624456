"""Every kind of world, with every kind of drift that it takes."""

from __future__ import annotations

from rtcore.config import DriftConfig, EnvConfig, MdpConfig, PhysicsConfig, RewardConfig

SINE = DriftConfig(kind="sine", offset=0.5, amplitude=1.0, omega=0.3)
WEIGHT = DriftConfig(kind="sine", offset=0.5, amplitude=0.5, omega=0.3)
PHYSICS = PhysicsConfig(
    mass=DriftConfig(kind="sine", offset=1.0, amplitude=0.4, omega=0.3),
    friction=DriftConfig(kind="switch", offset=1.0, amplitude=-0.5, at=3, every=4),
    gravity=DriftConfig(kind="ou", offset=1.0, sd=0.1),
)
NONE = DriftConfig(kind="none")
WORLDS = {
    "halfcheetah": EnvConfig(drift=SINE),
    "halfcheetah_at_one_physics_step": EnvConfig(drift=SINE, hz=200.0, speed=2.0),
    "halfcheetah_plain": EnvConfig(drift=NONE, hz=100.0, speed=3.0),
    "swimmer": EnvConfig(id="Swimmer-v5", drift=SINE, reward=RewardConfig(control_cost=1e-4)),
    "pointmass": EnvConfig(id="pointmass", drift=SINE),
    "pointmass_twice": EnvConfig(id="pointmass", drift=SINE, hz=10.0, speed=1.0),
    "pendulum": EnvConfig(id="Pendulum-v1", drift=NONE),
    "hopper": EnvConfig(id="Hopper-v5", drift=NONE),  # one that terminates
    "halfcheetah_walk": EnvConfig(drift=DriftConfig(kind="random_walk", sd=0.3)),
    "halfcheetah_physics": EnvConfig(drift=SINE, physics=PHYSICS),
    "hopper_physics": EnvConfig(id="Hopper-v5", drift=NONE, physics=PHYSICS),
    "pointmass_physics": EnvConfig(
        id="pointmass", drift=SINE, physics=PhysicsConfig(mass=PHYSICS.mass, friction=PHYSICS.friction)
    ),
    "cliffworld": EnvConfig(id="cliffworld", hz=10.0, drift=DriftConfig(kind="switch", amplitude=1.0, at=6)),
    "bandit": EnvConfig(id="bandit", hz=10.0, drift=WEIGHT),
    "random_mdp": EnvConfig(id="random_mdp", hz=10.0, drift=WEIGHT, mdp=MdpConfig(drifting="both")),
    "chain": EnvConfig(id="chain", hz=10.0, drift=WEIGHT, mdp=MdpConfig(slip=0.2)),
}
