"""Plans docks and undocks, with the pipelines of the resulting bodies. Slow, so it runs in a worker."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from firmware_py.core.body import Body
from firmware_py.core.docking_decisions import Prepared
from firmware_py.core.docking_plan import UndockPlan
from firmware_py.core.joints import turned
from firmware_py.core.names import name_module
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import DockRequest, PartRequest
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.docking import plan_dock, plan_undock

DONE_SINCE = {"dock": "a dock was asked for, and they have docked since", "undock": "an undock was asked for, and they have parted since"}
"""Reason why a request that waited for the worker is not planned any more, by its kind. By now it would be of the other kind, which the
event names."""


def job_key(request: DockRequest | PartRequest, bodies: Sequence[Body]) -> tuple[str, int | None]:
    """Key of a request's job for the worker: its kind, and the index of the body. A newer job with the same key replaces a waiting one."""
    joint = request.joints[0] if isinstance(request, PartRequest) else request
    of_body = {module: body for body in bodies for module in body.modules}
    body = of_body.get(joint.module)
    together = body is of_body.get(joint.target_module)
    kind = "part" if joint is not request else "undock" if together else "dock"
    return kind, None if body is None else body.index


def prepare(request: DockRequest | PartRequest, kind: str, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    """The plan for `request`, or the reason why there is none; never raises for an infeasible request.

    Args:
        kind: that of its `job_key` when it was made. Repeated before its modules docked, a dock would otherwise be planned as their undock.
        vehicles: by fleet index.
    """
    present = pipeline.bodies  # once: the loop runs meanwhile, and may join or part them
    bodies = {module: body for body in present for module in body.modules}
    if isinstance(request, PartRequest):
        return _prepare_part(request, bodies, pipeline, vehicles, pitch_m)
    if job_key(request, present)[0] != kind:
        return Prepared(request, None, (), DONE_SINCE[kind])
    return _prepare_dock(request, bodies, pipeline, vehicles, pitch_m)


Bodies = Mapping[int, Body]
"""The present bodies, by module."""


def _prepare_part(request: PartRequest, bodies: Bodies, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    """Plans the parting at the first joint, tried from both sides, at which the body has split into two connected bodies."""
    refusal = "they are apart already"
    for joint in (*request.joints, *map(turned, request.joints)):
        whole = bodies[joint.module]
        if whole is not bodies[joint.target_module]:
            continue
        try:
            plan = plan_undock(joint, whole, vehicles, pitch_m, lost=request.joints)
        except DescriptionError as error:
            refusal = str(error)
            continue
        return _parting(plan.opens[0], plan, pipeline)
    return Prepared(request.joints[0], None, (), refusal)


def _parting(request: DockRequest, plan: UndockPlan, pipeline: Pipeline) -> Prepared:
    return Prepared(request, plan, (pipeline.body_pipeline_of(plan.stays), pipeline.body_pipeline_of(plan.leaves)))


def _prepare_dock(request: DockRequest, bodies: Bodies, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    active, target = bodies.get(request.module), bodies.get(request.target_module)
    if active is None or target is None:
        return Prepared(request, None, (), f"there is no {name_module(request.module)} or {name_module(request.target_module)}")
    try:
        if active is target:
            return _parting(request, plan_undock(request, active, vehicles, pitch_m), pipeline)
        plan = plan_dock(request, active, target, vehicles, pitch_m)
    except DescriptionError as error:
        return Prepared(request, None, (), str(error))
    return Prepared(request, plan, (pipeline.body_pipeline_of(plan.merged),))
