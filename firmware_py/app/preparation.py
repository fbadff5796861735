"""Plans of docks and undocks with the pipelines of the bodies that there will be: slow, so a worker's."""

from __future__ import annotations

from collections.abc import Sequence

from firmware_py.core.docking import Prepared
from firmware_py.core.pipeline import Pipeline
from firmware_py.core.types import DockRequest
from firmware_py.description.schema import DescriptionError
from firmware_py.description.vehicle import Vehicle
from firmware_py.prepare.docking import plan_dock, plan_undock


def prepare_dock(request: DockRequest, pipeline: Pipeline, vehicles: Sequence[Vehicle], pitch_m: float) -> Prepared:
    """The plan for `request`, or in words why there is none; never raises for a request that cannot be met.

    Args:
        vehicles: by fleet index.
    """
    bodies = {module: body for body in pipeline.bodies for module in body.modules}
    active, target = bodies.get(request.module), bodies.get(request.target_module)
    if active is None or target is None:
        return Prepared(request, None, (), f"there is no module {request.module} or {request.target_module}")
    try:
        if active is target:
            parting = plan_undock(request, active, vehicles, pitch_m)
            return Prepared(parting.request, parting, (pipeline.chain_of(parting.stays), pipeline.chain_of(parting.leaves)))
        plan = plan_dock(request, active, target, vehicles, pitch_m)
    except DescriptionError as error:
        return Prepared(request, None, (), str(error))
    return Prepared(request, plan, (pipeline.chain_of(plan.merged),))
