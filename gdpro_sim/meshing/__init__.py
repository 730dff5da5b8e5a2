"""From a mesh file to a clean coloured surface, its tetrahedra, and the embedding of one in the other.

In pipeline order: `load` (mesh files to `surface.SurfaceMesh`), `repair` and `remesh` (clean, decimate,
subdivide), `color` and `proximity` (look-ups on a surface), `tetrahedralize` (to `tetmesh.TetMesh`; `lattice`
is its fallback), `embedding` (`tetmesh.Embedding`).
"""
