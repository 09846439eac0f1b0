"""Friction of the cylinders' seals: dry, in one of four forms; viscous, by direction."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from hil_sim.effects.base import JointEffect, Tables, in_unit
from rig.model.quantity import Length, Speed

Drag = Annotated[float, in_unit("N*s/m")]
Force = Annotated[float, in_unit("N")]
ForcePerPressure = Annotated[float, in_unit("N/Pa")]
PerLength = Annotated[float, in_unit("m^-1")]
# Bound of the bristle's relaxation rate [1/s], for stability with the fixed step.
BRISTLE_LIMIT = 8e3


class _Friction(JointEffect):
    """Dry friction in one of four forms.

    ``bristle`` (LuGre, with micro-damping), ``dahl`` (bristles without damping), and two without
    memory, smooth over the speed `width`: ``tanh`` and ``root``, v / sqrt(v^2 + width^2).
    """

    form: Literal["bristle", "dahl", "tanh", "root"] = "bristle"
    presliding: Length = Field(default=40e-6, gt=0, description="bristle deflection at slip [m]")
    width: Speed = Field(default=1e-3, gt=0, description="of tanh and root [m/s]")

    def add_contact(self, t: Tables, force: float) -> None:
        """Add `force` [N] to the joint's sliding contact; its frictions share one form."""
        row = t.joints[self.joint : (self.joint or 0) + 1]
        row["friction_scale"] += force
        if self.form in ("tanh", "root"):
            row["friction_width"] = self.width
            row["friction_corner"] = float(self.form == "root")
            return
        # Friction of several causes shares one set of bristles: their stiffnesses add.
        row["bristle_stiffness"] += force / self.presliding
        row["bristle_limit"] = BRISTLE_LIMIT
        if self.form == "bristle":
            # Enough micro-damping to prevent oscillation in presliding, little against Fv G^-2.
            row["bristle_damping"] += 2e-3 * force / self.presliding


class CoulombFriction(_Friction):
    """Dry friction of the cylinder's seals; in a tapered bore it grows along the stroke."""

    sizes: ClassVar = {"force": (20.0, 120.0)}

    name: Literal["coulomb_friction"]
    force: Force = Field(gt=0)
    taper: PerLength = Field(default=0.0, description="growth from mid-stroke [1/m]")

    def apply(self, t: Tables) -> None:
        t.joints["friction_plus"][self.joint] += self.force
        t.joints["friction_minus"][self.joint] += self.force
        t.joints["friction_taper"][self.joint] += self.taper
        self.add_contact(t, self.force)


class StribeckFriction(_Friction):
    """Breakaway force above Coulomb's that falls off over `speed`."""

    sizes: ClassVar = {"force": (40.0, 120.0), "speed": (0.01, 0.04)}

    name: Literal["stribeck_friction"]
    force: Force = Field(gt=0)
    speed: Speed = Field(gt=0)

    def apply(self, t: Tables) -> None:
        t.joints["stribeck"][self.joint] += self.force
        t.joints["stribeck_speed"][self.joint] = self.speed
        self.add_contact(t, self.force)


class AsymmetricFriction(_Friction):
    """Dry friction that differs with direction."""

    sizes: ClassVar = {"extending": (40.0, 120.0), "retracting": (5.0, 20.0)}

    name: Literal["asymmetric_friction"]
    extending: Force = Field(ge=0)
    retracting: Force = Field(ge=0)

    @model_validator(mode="after")
    def _some(self) -> Self:
        if self.extending == self.retracting == 0:
            raise ValueError("extending and retracting are both zero; give one of them")
        return self

    def apply(self, t: Tables) -> None:
        t.joints["friction_plus"][self.joint] += self.extending
        t.joints["friction_minus"][self.joint] += self.retracting
        self.add_contact(t, max(self.extending, self.retracting))


class PressureDependentFriction(_Friction):
    """Dry friction proportional to the seals' pressures: coefficient (p_cap + p_rod)."""

    sizes: ClassVar = {"coefficient": (6e-6, 3e-5)}

    name: Literal["pressure_dependent_friction"]
    coefficient: ForcePerPressure = Field(gt=0)

    def apply(self, t: Tables) -> None:
        t.joints["friction_pressure"][self.joint] += self.coefficient
        self.add_contact(t, self.coefficient * t.rig.supply.pressure)


class AsymmetricViscousFriction(JointEffect):
    """Viscous friction in addition to the joint's that differs with direction.

    ``seal`` acts at the piston, ``bearing`` at the joint (by the same slopes at mid-stroke),
    ``thinning`` at the piston with a film that thins with shear: c v / (1 + |v| / 0.5 m/s).
    """

    sizes: ClassVar = {"extending": (150.0, 500.0), "retracting": (20.0, 60.0)}
    name: Literal["asymmetric_viscous_friction"]
    extending: Drag = Field(ge=0)
    retracting: Drag = Field(ge=0)
    form: Literal["seal", "bearing", "thinning"] = "seal"

    @model_validator(mode="after")
    def _differ(self) -> Self:
        if self.extending == self.retracting:
            raise ValueError("extending and retracting are equal: that is the joint's own Fv")
        return self

    def apply(self, t: Tables) -> None:
        t.joints["drag_plus"][self.joint] += self.extending
        t.joints["drag_minus"][self.joint] += self.retracting
        t.joints["drag_thinning"][self.joint] = 2.0 if self.form == "thinning" else 0.0
        if self.form == "bearing":
            lever = t.rig.joints[self.joint or 0].linkage.jacobian(
                t.rig.joints[self.joint or 0].linkage.angle(0.0)
            )
            t.joints["drag_lever"][self.joint] = abs(float(lever))
