"""A session whose methods are the operations: what `slviewer.Session` is."""

from slviewer.pipeline import (
    calibrate,
    compare,
    inspect_parts,
    measure,
)
from slviewer.pipeline.accept import accept, check, validate
from slviewer.pipeline.edit import edit_scan, set_region
from slviewer.pipeline.export import export
from slviewer.pipeline.merge import align, merge
from slviewer.pipeline.mesh import mesh
from slviewer.pipeline.operation import load_arrays
from slviewer.pipeline.reconstruct import reconstruct, verify
from slviewer.pipeline.report import inspect, report
from slviewer.session.store import Session


class SessionOperations(Session):
    """A session on disk: captures, results and decisions, and what is done with them.

    Each method is the command of its name, with the session as first argument; it needs no open
    session to be called as a function, as in ``slviewer.verify(folder, ["plane_01"], "plane")``::

        with slviewer.Session.open("my-session", write=True) as session:
            session.calibrate("circles:21x16:9")
            session.reconstruct("object").only.points
    """

    accept = accept
    align = align
    calibrate = calibrate.calibrate
    check = check
    compare = compare.compare
    edit_scan = edit_scan
    export = export
    inspect = inspect
    load_arrays = load_arrays
    measure = measure.measure
    merge = merge
    mesh = mesh
    plan = inspect_parts.plan
    reconstruct = reconstruct
    report = report
    run_plan = inspect_parts.run_plan
    set_region = set_region
    validate = validate
    verify = verify
