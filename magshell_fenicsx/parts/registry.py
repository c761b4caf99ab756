"""The registry of all that adds something to a case: classes by what they are, as text.

A line is the module here and the class in it. A module is imported when its class is asked for, so
all may be found from here. An ability is what a section adds to a problem; a step is a part of the
load programme; observables are what is read from a state. Bodies, imperfections, sources and laws
have a file each, named after their key `kind` or `law`.
"""

from importlib import import_module
from typing import Any

REGISTERED: dict[str, tuple[str, ...]] = {
    "abilities": (  # in the order in which they are asked
        "foundation.Foundation",
        "supports.boundary.BoundarySection",
        "magnetism.fields.MagneticSection",
        "magnetism.sensors.Sensing",
        "magnetism.field_maps.FieldMapping",
        "natural.section.NaturalSection",
        "imperfections.imperfection.Imperfect",
        "laminate.ShellLaminate",
        "laws.rubber_material.RubberMaterial",
        "motion.history.ViscousMaterial",
        "bodies.body.RigidBodies",
        "contact.contact_section.ShellContact",
        "joints.CaseJoints",
        "stress.StressPoints",
    ),
    "steps": (  # in the order of the documentation
        "pressure.pressure.PressureSection",
        "forces.indentation.IndentationSection",
        "magnetism.field_step.FieldSection",
        "magnetism.field_step.RotationSection",
        "natural.section.GrowthSection",
        "imperfections.growth.ImperfectionStep",
        "forces.dead_load_step.DeadSection",
        "supports.motion.EdgeSection",
        "bodies.contact_step.ContactSection",
        "magnetism.source_step.SourceStep",
        "motion.motion_step.TimeSection",
        "spin.SpinStep",
        "gravity.GravityStep",
        "magnetism.interaction.InteractionStep",
        "joints.CreaseStep",
    ),
    "observables": (  # in the order of columns, and of the lines of `magshell check`
        "magnetism.readings.FieldObservables",
        "natural.section.NaturalObservables",
        "imperfections.growth.GrowingObservables",
        "pressure.pressure.PressureObservables",
        "forces.dead_load_step.ForcesObservables",
        "supports.reacting.ReactionsObservables",
        "magnetism.source_step.SourcesObservables",
        "magnetism.readings.SoftObservables",
        "magnetism.interaction.InteractionObservables",
        "magnetism.readings.SensorsObservables",
        "bodies.contact_step.BodiesObservables",
        "bodies.body_forces.BodyForcesObservables",
        "contact.contact_observables.ContactObservables",
        "joints.CreaseObservables",
        "shell_observables.EnergyObservables",
        "shell_observables.PointObservables",
        "shell_observables.OwnEnergyObservables",
        "stress.StressObservables",
    ),
    "bodies": (  # in the order of the documentation, as all that follow
        "bodies.plane.PlaneSection",
        "bodies.sphere.SphereBodySection",
        "bodies.cylinder.CylinderBodySection",
        "bodies.rod.RodSection",
        "bodies.box.BoxSection",
        "bodies.ellipsoid.EllipsoidSection",
    ),
    "imperfections": (
        "imperfections.dimple.DimpleSection",
        "imperfections.gaussian.GaussianSection",
        "imperfections.formula.FormulaSection",
        "imperfections.data.DataSection",
        "imperfections.modes.ModesSection",
        "imperfections.random.RandomSection",
    ),
    "sources": (
        "magnetism.sources.cylinder.CylinderSection",
        "magnetism.sources.cuboid.CuboidSection",
        "magnetism.sources.sphere.SphereSection",
        "magnetism.sources.ring.RingSection",
        "magnetism.sources.coil.CoilSection",
        "magnetism.sources.grid.GridSection",
        "magnetism.sources.formula.FormulaSource",
    ),
    "laws": (
        "laws.koiter.KoiterSection",
        "laws.neo_hookean.NeoHookeanSection",
        "laws.mooney_rivlin.MooneyRivlinSection",
        "laws.ogden.OgdenSection",
    ),
}


def registered_classes(role: str) -> tuple[Any, ...]:
    """Return the classes that are registered under a role, such as "bodies", in their order."""
    paths = (path.rpartition(".") for path in REGISTERED[role])
    return tuple(getattr(import_module(f"{__package__}.{path}"), name) for path, _, name in paths)
