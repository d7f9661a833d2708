"""What the surface of a body file must be for silhouettes and visibility: closed, wound one way, without slivers."""

from __future__ import annotations

import numpy as np

from ihbench.body import Body

SLIVER = 1e-6  # m, height below which a triangle has no direction


def look_at_mesh(body: Body) -> tuple[str, tuple[str, ...]]:
    """One line on the rest-pose surface, and what of it would make holes or false fronts; by trimesh."""
    import trimesh

    mesh = trimesh.Trimesh(body.v_template, body.faces, process=False)
    open_edges = len(trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1))
    slivers = int((~mesh.nondegenerate_faces(height=SLIVER)).sum())
    warnings = []
    if not mesh.is_watertight:
        warnings.append(f"body mesh: not closed ({open_edges} open edges); what is behind it shows through the holes")
    if not mesh.is_winding_consistent:
        warnings.append("body mesh: neighbouring triangles are wound in opposite senses; some fronts count as backs")
    elif mesh.is_watertight and mesh.volume < 0:
        warnings.append("body mesh: inside out, its triangles are wound clockwise; fronts count as backs")
    if slivers:
        warnings.append(f"body mesh: {slivers} triangles without area; they have no normal")
    size = np.ptp(body.v_template, axis=0).max()
    state = "closed and wound one way" if not warnings else "see warnings"
    return f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, {size:.2f} m, {state}", tuple(warnings)
