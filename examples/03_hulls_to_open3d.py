"""Carve the visual hull of some frames, and hand it to Open3D as coloured point clouds and a mesh.

    python examples/03_hulls_to_open3d.py [CAPTURE] [--frames 3] [--voxels 64] [--out hulls] [--show]

Without CAPTURE it takes the one that ships with tk. --show opens a window, where there is a display.
"""

import argparse
from pathlib import Path

import numpy as np
import open3d as o3d

import tk
from tk.model.cameras.volume import VoxelGrid
from tk.run.segmentation import make_labeller
from tk.run.task import Task

DEMO = Path(tk.__file__).parent / "data" / "demo"

parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("capture", nargs="?", type=Path, default=DEMO)
parser.add_argument("--frames", type=int, default=3, help="how many")
parser.add_argument("--voxels", type=int, default=64, help="along the volume's longest side")
parser.add_argument("--out", type=Path, default=Path("hulls"), help="folder")
parser.add_argument("--show", action="store_true")
options = parser.parse_args()
options.out.mkdir(parents=True, exist_ok=True)

capture = tk.open_capture(options.capture)
label = make_labeller(Task.of(capture, tk.Settings()), print)  # its masks, or those made against the empty scene
grid = VoxelGrid.cover(capture.volume, options.voxels)
hull = tk.VisualHull(capture.rig, grid)

with capture.frames(0, options.frames) as frames:
    for frame in frames:
        hull.update(label(frame).masks)
        surface = hull.surface(frame.images)  # voxels on the surface, with normals, and colours from the cameras
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(surface.positions.astype(float)))
        cloud.normals = o3d.utility.Vector3dVector(surface.normals.astype(float))
        cloud.colors = o3d.utility.Vector3dVector(surface.colors[:, ::-1].clip(0, 255).astype(float) / 255)  # BGR
        o3d.io.write_point_cloud(options.out / f"{frame.index:06d}.ply", cloud)
        litres = 1000 * hull.occupancy.astype(bool).sum() * grid.voxel_m**3
        height = cloud.get_axis_aligned_bounding_box().get_extent()[2]
        print(f"frame {frame.index}: {len(cloud.points)} voxels, {litres:.0f} litres, {height:.2f} m high")

# the last frame as a closed surface; a voxel that stands alone has no normal
has_normal = np.flatnonzero(np.linalg.norm(surface.normals, axis=1) > 0.5)
cloud = cloud.select_by_index(has_normal)
mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=6, n_threads=1)
mesh.compute_vertex_normals()
o3d.io.write_triangle_mesh(options.out / "last.ply", mesh)
print(f"wrote {options.out / 'last.ply'}: {len(mesh.triangles)} triangles")
if options.show:
    o3d.visualization.draw_geometries([mesh])
