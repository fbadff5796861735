"""Plans of docks and undocks with the pipelines of the bodies that there will be: slow, so a worker's."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_py.core.docking import Prepared
from firmware_py.core.docking_sequence import UndockPlan
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import DockRequest, PartRequest
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.docking import plan_dock, plan_undock


def prepare(request: DockRequest | PartRequest, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    """The plan for `request`, or in words why there is none; never raises for a request that cannot be met.

    Args:
        vehicles: by fleet index.
    """
    if isinstance(request, PartRequest):
        return _prepare_part(request, pipeline, vehicles, pitch_m)
    return _prepare_dock(request, pipeline, vehicles, pitch_m)


def _prepare_part(request: PartRequest, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    """At the first joint where the body has come apart."""
    bodies, refusal = {module: body for body in pipeline.bodies for module in body.modules}, ""
    for joint in request.joints:
        whole = bodies[joint.module]
        if whole is not bodies[joint.target_module]:
            continue
        try:
            plan = plan_undock(joint, whole, vehicles, pitch_m, also_open=request.joints)
        except DescriptionError as error:
            refusal = str(error)
            continue
        return _parting(plan, pipeline)
    return Prepared(request.joints[0], None, (), refusal or "they are apart already")


def _parting(plan: UndockPlan, pipeline: Pipeline) -> Prepared:
    return Prepared(plan.request, plan, (pipeline.chain_of(plan.stays), pipeline.chain_of(plan.leaves)))


def _prepare_dock(request: DockRequest, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    bodies = {module: body for body in pipeline.bodies for module in body.modules}
    active, target = bodies.get(request.module), bodies.get(request.target_module)
    if active is None or target is None:
        return Prepared(request, None, (), f"there is no module {request.module} or {request.target_module}")
    try:
        if active is target:
            return _parting(plan_undock(request, active, vehicles, pitch_m), pipeline)
        plan = plan_dock(request, active, target, vehicles, pitch_m)
    except DescriptionError as error:
        return Prepared(request, None, (), str(error))
    return Prepared(request, plan, (pipeline.chain_of(plan.merged),))
