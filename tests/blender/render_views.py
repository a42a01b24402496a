# tests/blender/render_views.py - views of an export, rendered by Cycles under the solve's lights.
#   blender -b --factory-startup --python render_views.py -- EXPORT_DIR CAMERAS_DIR OUT_DIR glb|layers WIDTHxHEIGHT SAMPLES VIEW...
# CAMERAS_DIR: COLMAP text with PINHOLE cameras, whose field of view is kept. Linear EXR.
import importlib.util
import os
import sys

import bpy
import numpy
from mathutils import Matrix, Quaternion, Vector

export, cameras, out, mode, size, samples, *views = sys.argv[sys.argv.index("--") + 1:]
width, height = map(int, size.split("x"))
here = os.path.dirname(os.path.abspath(__file__))
spec = importlib.util.spec_from_file_location("studiorig", os.path.join(here, "../../config/blender/import_studiorig.py"))
studiorig = importlib.util.module_from_spec(spec)
spec.loader.exec_module(studiorig)

for thing in list(bpy.data.objects):
    bpy.data.objects.remove(thing)
if mode == "glb":
    numpy.bool = bool  # Debian 12: the importer of Blender 3.4 asks NumPy 1.24 for a name it no longer has
    bpy.ops.import_scene.gltf(filepath=os.path.join(export, "model.glb"))
studiorig.load(export, model=mode == "layers", lights=True)
for thing in bpy.data.objects:
    if thing.type == "MESH":
        for polygon in thing.data.polygons:
            polygon.use_smooth = True

scene = bpy.context.scene
scene.render.engine = "CYCLES"
scene.cycles.device = "CPU"
scene.cycles.samples = int(samples)
scene.cycles.use_denoising = False
scene.cycles.use_adaptive_sampling = False
scene.cycles.max_bounces = 0  # direct light only, as the solver's model
scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 0
scene.cycles.light_threshold = 0
scene.cycles.sample_clamp_direct = 0
scene.cycles.pixel_filter_type = "BOX"
scene.cycles.seed = 1
scene.world = bpy.data.worlds.new("black")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0, 0, 0, 1)
scene.render.film_transparent = True
scene.render.resolution_x, scene.render.resolution_y = width, height
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
scene.render.image_settings.exr_codec = "ZIP"


def rows(name):
    with open(os.path.join(cameras, name)) as file:
        return [line.split() for line in file if not line.startswith("#")]


intrinsics = {row[0]: row for row in rows("cameras.txt") if row}
for row in rows("images.txt")[::2]:
    name = os.path.splitext(row[9])[0]
    if name not in views:
        continue
    camera = intrinsics[row[8]]
    assert camera[1] == "PINHOLE", camera
    w, h, fx, fy, cx, cy = map(float, camera[2:8])
    q = Quaternion(list(map(float, row[1:5])))
    world_from_cam = q.to_matrix().transposed()
    centre = -(world_from_cam @ Vector(list(map(float, row[5:8]))))
    data = bpy.data.cameras.new(name)
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = 36
    data.lens = 36 * fx / w
    data.shift_x = (w / 2 - cx) / w
    data.shift_y = (cy - h / 2) / w
    data.clip_start = 0.001
    thing = bpy.data.objects.new(name, data)
    flip = Matrix(((1, 0, 0), (0, -1, 0), (0, 0, -1)))  # OpenCV's axes to Blender's
    thing.matrix_world = Matrix.Translation(centre) @ (world_from_cam @ flip).to_4x4()
    scene.collection.objects.link(thing)
    scene.camera = thing
    scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = 1, 1
    scene.render.filepath = os.path.join(out, name + ".exr")
    bpy.ops.render.render(write_still=True)
