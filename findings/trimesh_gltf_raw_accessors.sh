#!/usr/bin/env bash
# glTF in trimesh: what is loaded is the raw first accessor, not the mesh that the file describes
#
# Expected: a valid file gives the vertices that a viewer shows, or an error where trimesh lacks a feature. A file that
#           *requires* an extension must not be read without it.
# Seen:     four times the wrong place, without a word, where VTK and the specification agree with each other:
#           - a skinned mesh: the transform of its own node counts (it is to be ignored), its joints do not
#           - morph targets: the weights stored with the mesh count for nothing
#           - a sparse accessor (exporters write corrected vertices so): the corrections are dropped
#           - KHR_mesh_quantization, required: normalized 16-bit integers are not divided, the mesh is 32,767 times too
#             big (VTK refuses the file, as it has to)
# Versions: trimesh 5.2.0, pygltflib 1.16.5 (writes the files), vtk 9.7.2 (the peer), numpy 2.4.6.
# So:       bodies and garments from avatar tools are skinned, morphed and quantised as a rule. Look at
#           extensionsRequired, skins, weights and sparse before trusting the vertices, or convert with a full importer
#           first.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
"${PYTHON:-python3}" -m venv "$work/venv"
"$work/venv/bin/python" -m pip install -qq --disable-pip-version-check \
  trimesh==5.2.0 pygltflib==1.16.5 vtk==9.7.2 numpy==2.4.6 scipy==1.17.1
cat >"$work/show.py" <<'PY'
import sys

import numpy as np
import pygltflib as gltf
import trimesh
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkLogger
from vtkmodules.vtkFiltersGeometry import vtkCompositeDataGeometryFilter
from vtkmodules.vtkIOGeometry import vtkGLTFReader

vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
CORNERS = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
KIND = {"float32": 5126, "uint16": 5123, "uint8": 5121, "int16": 5122}
SHAPE = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class File:
    """One triangle in a binary glTF."""

    def __init__(self, **top):
        self.blob, self.views, self.accessors = b"", [], []
        self.nodes, self.mesh, self.top = [gltf.Node(mesh=0)], gltf.Mesh(), top

    def view(self, array):
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.views.append(gltf.BufferView(buffer=0, byteOffset=len(self.blob), byteLength=array.nbytes))
        self.blob += array.tobytes()
        return len(self.views) - 1

    def add(self, array, **more):
        accessor = gltf.Accessor(
            bufferView=self.view(array),
            componentType=KIND[str(array.dtype)],
            count=len(array),
            type=SHAPE[array.shape[1:]],
            **more,
        )
        if array.shape[1:] == (3,):
            accessor.min, accessor.max = array.min(0).tolist(), array.max(0).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def triangle(self, position, targets=None, **attributes):
        self.mesh.primitives = [
            gltf.Primitive(
                attributes=gltf.Attributes(POSITION=position, **attributes),
                indices=self.add(np.uint16([0, 1, 2])),
                targets=targets,
            )
        ]

    def read(self, name):
        document = gltf.GLTF2(
            asset=gltf.Asset(version="2.0"), scene=0, scenes=[gltf.Scene(nodes=list(range(len(self.nodes))))],
            nodes=self.nodes, meshes=[self.mesh], accessors=self.accessors, bufferViews=self.views,
            buffers=[gltf.Buffer(byteLength=len(self.blob))], **self.top,
        )  # fmt: skip
        document.set_binary_blob(self.blob)
        document.save(f"{name}.glb")
        by_trimesh = np.asarray(trimesh.load_scene(f"{name}.glb").to_mesh().vertices)
        reader, flat = vtkGLTFReader(), vtkCompositeDataGeometryFilter()
        reader.SetFileName(f"{name}.glb")
        flat.SetInputConnection(reader.GetOutputPort())
        flat.Update()
        data = flat.GetOutput().GetPoints()
        return by_trimesh, (vtk_to_numpy(data.GetData()) if data and data.GetNumberOfPoints() else None)


cases = {}

skinned = File(skins=[gltf.Skin(joints=[1])])
skinned.nodes = [gltf.Node(mesh=0, skin=0, translation=[10, 0, 0]), gltf.Node(name="joint", translation=[0, 0, 5])]
first = np.tile(np.float32([1, 0, 0, 0]), (3, 1))
skinned.triangle(skinned.add(CORNERS), JOINTS_0=skinned.add(np.zeros((3, 4), np.uint8)), WEIGHTS_0=skinned.add(first))
skinned.top["skins"][0].inverseBindMatrices = skinned.add(np.eye(4, dtype=np.float32)[None])
cases["skin"] = skinned, CORNERS + [0, 0, 5], CORNERS + [10, 0, 0]

morphed = File()
morphed.triangle(morphed.add(CORNERS), targets=[gltf.Attributes(POSITION=morphed.add(np.float32([[0, 0, 1]] * 3)))])
morphed.mesh.weights = [1.0]
cases["morph"] = morphed, CORNERS + [0, 0, 1], CORNERS

sparse = File()
sparse.triangle(sparse.add(CORNERS))
sparse.accessors[0].max = [5, 1, 0]
sparse.accessors[0].sparse = gltf.Sparse(
    count=1,
    indices=gltf.AccessorSparseIndices(bufferView=sparse.view(np.uint16([1])), componentType=5123),
    values=gltf.AccessorSparseValues(bufferView=sparse.view(np.float32([[5, 0, 0]]))),
)
cases["sparse"] = sparse, np.array([[0, 0, 0], [5, 0, 0], [0, 1, 0]]), CORNERS

small = File(extensionsUsed=["KHR_mesh_quantization"], extensionsRequired=["KHR_mesh_quantization"])
padded = np.int16([[0, 0, 0, 0], [32767, 0, 0, 0], [0, 32767, 0, 0]])  # rows of 8 bytes, as the format asks
small.triangle(small.add(padded, normalized=True))
small.accessors[0].type, small.views[0].byteStride, small.views[0].target = "VEC3", 8, 34962
small.accessors[0].min, small.accessors[0].max = [0, 0, 0], [32767, 32767, 0]
cases["quantised"] = small, CORNERS, 32767 * CORNERS

still = True
print("trimesh", trimesh.__version__)
same = lambda a, b: a is not None and len(a) == len(b) and np.allclose(np.sort(a, 0), np.sort(b, 0), atol=1e-4)
for name, (file, expected, seen) in cases.items():
    by_trimesh, by_vtk = file.read(name)
    told = "nothing" if by_vtk is None else by_vtk[1].round(3).tolist()
    print(
        f"{name:10} second corner: expected {expected[1].tolist()},",
        f"seen in trimesh {by_trimesh[1].tolist()}, in VTK {told}",
    )
    still &= same(by_trimesh, seen) and (by_vtk is None if name == "quantised" else same(by_vtk, expected))
sys.exit(0 if still else "no longer so: trimesh, or its peer, reads one of these differently")
PY
cd "$work"
"$work/venv/bin/python" show.py
