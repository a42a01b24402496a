# tests/blender/make_studio.py - blender -b --factory-startup --python-exit-code 1 --python make_studio.py -- OUT SUBJECT SEED [SAMPLES]
#
# A studio that another renderer sees: Cycles traces paths (six bounces: shadows and interreflection are in) around SUBJECT (bust: one stone;
# torus: paint and rubber; monkey: plastic, chalk and steel, with hollows), under area lights in a grey room. OUT is a take for rigsolve:
# views, mesh, cameras, panorama (subject removed, taken some cm off its middle, turned by 6 to 12 degrees against start.json), unseen.txt;
# truth/ (probe, lights, material); relit/: six views under other lights, their panorama, and masks of the pixels that are all subject.
import bpy, json, math, os, random, sys
from mathutils import Matrix, Quaternion, Vector

out, subject, seed, samples = (sys.argv[sys.argv.index("--") + 1:] + ["36"])[:4]
seed, samples = int(seed), int(samples)
draw = random.Random(seed)
SIZE, PANORAMA, N_VIEWS, N_RELIT = (360, 240), (768, 384), 36, 6
SUBJECTS = { # name, parameters of Principled BSDF, two base colours, size of their pattern; which of them a face at (c - middle) has
    "bust": ([("stone", {"Roughness": .65, "Specular": .5}, (.45, .4, .3), (.2, .22, .2), 12)], lambda c: 0),
    "torus": ([("paint", {"Roughness": .3, "Specular": .5}, (.1, .2, .5), (.3, .4, .5), 8),
               ("rubber", {"Roughness": .7, "Specular": .4}, (.08, .08, .08), (.2, .18, .15), 10)], lambda c: 0 if c.x > 0 else 1),
    "monkey": ([("plastic", {"Roughness": .4, "Specular": .5}, (.5, .06, .04), (.25, .02, .02), 9),
                ("chalk", {"Roughness": .9, "Specular": .2}, (.6, .55, .4), (.35, .3, .2), 14),
                ("steel", {"Roughness": .45, "Metallic": 1.}, (.6, .6, .62), (.5, .48, .45), 5)],
               lambda c: 2 if c.z > .075 else 1 if c.z < -.03 else 0),
}
PROBE_UPRIGHT = Matrix(((-1, 0, 0), (0, 0, 1), (0, 1, 0))) # world_from_probe of a panorama whose middle looks along world +Y, with Z up

bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.engine, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = "CYCLES", False, False
scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 6
scene.cycles.sample_clamp_indirect = scene.cycles.blur_glossy = 0
scene.cycles.pixel_filter_type = "BOX" # a pixel is the mean over its own area, as a photosite is
scene.render.filter_size = 1
scene.render.image_settings.file_format, scene.render.image_settings.color_depth, scene.render.image_settings.color_mode = "OPEN_EXR", "16", "RGB"
scene.view_settings.view_transform = "Raw"
scene.world = bpy.data.worlds.new("dark")
scene.world.color = (0, 0, 0)
middle = Vector((0, .05, 1.5))


def material(name, parameters, dark=None, bright=None, scale=1):
    m = bpy.data.materials.new(name)
    m.use_nodes = True
    nodes, bsdf = m.node_tree.nodes, m.node_tree.nodes["Principled BSDF"]
    bsdf.distribution = "GGX"
    for key, value in parameters.items():
        bsdf.inputs[key].default_value = value
    if dark:
        noise, ramp, place = nodes.new("ShaderNodeTexNoise"), nodes.new("ShaderNodeValToRGB"), nodes.new("ShaderNodeTexCoord")
        noise.inputs["Scale"].default_value, noise.inputs["Detail"].default_value = scale, 4
        for k, (at, colour) in enumerate(((.4, dark), (.6, bright))):
            ramp.color_ramp.elements[k].position, ramp.color_ramp.elements[k].color = at, (*colour, 1)
        m.node_tree.links.new(place.outputs["Object"], noise.inputs["Vector"])
        m.node_tree.links.new(noise.outputs["Fac"], ramp.inputs["Fac"])
        m.node_tree.links.new(ramp.outputs["Color"], bsdf.inputs["Base Color"])
    return m


def emission(name, radiance):
    m = bpy.data.materials.new(name)
    m.use_nodes = True
    m.node_tree.nodes.clear()
    new, link = m.node_tree.nodes.new, m.node_tree.links.new
    light, back, side, mix, end = (new("ShaderNode" + n) for n in ("Emission", "BsdfDiffuse", "NewGeometry", "MixShader", "OutputMaterial"))
    light.inputs[0].default_value, back.inputs[0].default_value = (*radiance, 1), (.03, .03, .03, 1)
    link(side.outputs["Backfacing"], mix.inputs[0])
    link(light.outputs[0], mix.inputs[1])
    link(back.outputs[0], mix.inputs[2])
    link(mix.outputs[0], end.inputs[0])
    return m


def make_subject():
    if subject == "monkey":
        bpy.ops.mesh.primitive_monkey_add(size=.34, location=middle, rotation=(0, 0, .4))
        bpy.context.object.modifiers.new("smooth", "SUBSURF").levels = 2
    elif subject == "torus":
        bpy.ops.mesh.primitive_torus_add(major_radius=.13, minor_radius=.055, major_segments=96, minor_segments=48, location=middle, rotation=(.9, .3, 0))
    else:
        bpy.ops.mesh.primitive_uv_sphere_add(radius=.14, segments=96, ring_count=64, location=middle)
        bumps = bpy.context.object.modifiers.new("bumps", "DISPLACE")
        bumps.texture, bumps.strength = bpy.data.textures.new("clouds", "CLOUDS"), .09
        bumps.texture.noise_scale = .15
    o = bpy.context.object
    for modifier in list(o.modifiers):
        bpy.ops.object.modifier_apply(modifier=modifier.name)
    bpy.ops.object.transform_apply(location=True, rotation=True, scale=True)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.quads_convert_to_tris()
    bpy.ops.uv.smart_project(angle_limit=math.radians(66), island_margin=.015)
    bpy.ops.object.mode_set(mode="OBJECT")
    kinds, which = SUBJECTS[subject]
    for kind in kinds:
        o.data.materials.append(material(*kind))
    for face in o.data.polygons:
        face.use_smooth, face.material_index = True, which(face.center - middle)
    json.dump([{"name": k[0], **k[1]} for k in kinds], open(out + "/truth/material.json", "w"), indent=1)
    bpy.ops.wm.obj_export(filepath=out + "/geometry/mesh.obj", export_selected_objects=True, export_materials=False, export_triangulated_mesh=True,
                          forward_axis="Y", up_axis="Z")
    return o


def place_lights(n, path):
    """n panels 2 m and more away, behind the cameras, each of about the same irradiance."""
    lights = []
    for i in range(n):
        azimuth, height = 2 * math.pi * (i + draw.uniform(-.3, .3)) / n, math.radians(draw.uniform(-5, 65))
        towards = Vector((math.cos(azimuth) * math.cos(height), math.sin(azimuth) * math.cos(height), math.sin(height)))
        at = middle + towards * draw.uniform(2, 2.6)
        at = Vector((max(-3, min(3, at.x)), max(-2.8, min(2.8, at.y)), max(.1, min(3.1, at.z))))
        size = draw.uniform(.7, 1.2), draw.uniform(.7, 1.4)
        radiance, tint = 3.2 / n * draw.uniform(.6, 1.4) * (at - middle).length_squared / (size[0] * size[1]), draw.uniform(-.08, .08)
        bpy.ops.mesh.primitive_plane_add(size=1, location=at)
        o = bpy.context.object
        o.rotation_mode, o.rotation_quaternion, o.scale = "QUATERNION", (middle - at).to_track_quat("Z", "Y"), (*size, 1)
        colour = (radiance * (1 + tint), radiance, radiance * (1 - tint))
        o.data.materials.append(emission("panel", colour))
        bpy.context.view_layer.update()
        lights.append((o, {"id": i, "centre": list(at), "normal": list((middle - at).normalized()), "width": size[0], "height": size[1], "radiance_rgb": colour,
                           "corners": [list(o.matrix_world @ Vector((x, y, 0))) for x, y in ((-.5, -.5), (.5, -.5), (.5, .5), (-.5, .5))],
                           "distance_to_subject_centre": (at - middle).length}))
    json.dump({"panels": [about for _, about in lights]}, open(path, "w"), indent=1)
    return [o for o, _ in lights]


def render(path, n_samples):
    scene.cycles.samples, scene.render.filepath = n_samples, path
    bpy.ops.render.render(write_still=True)


def photograph(n, name, pictures, cameras, masks=None):
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    eye.data.type, eye.data.sensor_width = "PERSP", 36
    poses = []
    for i in range(n):
        z, azimuth = -.55 + 1.45 * (1 - (i + .5) / n), i * 2.399963 + seed # evenly over a band of the sphere
        at = middle + Vector((math.sqrt(1 - z * z) * math.cos(azimuth), math.sqrt(1 - z * z) * math.sin(azimuth), z)) * draw.uniform(1.35, 1.6)
        at.z = min(max(at.z, .1), 3.1)
        focal_px, turn = draw.uniform(540, 660), (at - middle).to_track_quat("Z", "Y").to_matrix()
        eye.data.lens, eye.matrix_world = focal_px * 36 / SIZE[0], Matrix.Translation(at) @ turn.to_4x4()
        scene.cycles.seed = 1000 * seed + i
        render(f"{pictures}/{name}{i:03d}.exr", samples)
        if masks: # the subject alone, shining just more than the half that compare --mask asks for
            others = [o for o in scene.objects if o not in (body, eye)]
            for o in others:
                o.hide_render = True
            bpy.context.view_layer.material_override = emission("mask", (.503,) * 3)
            render(f"{masks}/{name}{i:03d}.exr", 16)
            bpy.context.view_layer.material_override = None
            for o in others:
                o.hide_render = False
        camera_from_world = Matrix(((1, 0, 0), (0, -1, 0), (0, 0, -1))) @ turn.transposed() # COLMAP: y down, z ahead
        poses.append((f"{name}{i:03d}.exr", focal_px, camera_from_world.to_quaternion(), -(camera_from_world @ at)))
    with open(cameras + "/cameras.txt", "w") as c, open(cameras + "/images.txt", "w") as p:
        for i, (picture, focal_px, q, t) in enumerate(poses, 1):
            c.write(f"{i} PINHOLE {SIZE[0]} {SIZE[1]} {focal_px:.9f} {focal_px:.9f} {SIZE[0] / 2} {SIZE[1] / 2}\n")
            p.write(f"{i} {q.w:.12f} {q.x:.12f} {q.y:.12f} {q.z:.12f} {t.x:.12f} {t.y:.12f} {t.z:.12f} {i} {picture}\n\n")
    open(cameras + "/points3D.txt", "w").close()


def take_panorama(path, probe, at, turn):
    scene.render.resolution_x, scene.render.resolution_y = PANORAMA
    eye.data.type, eye.data.cycles.panorama_type = "PANO", "EQUIRECTANGULAR"
    eye.matrix_world = Matrix.Translation(at) @ (turn @ Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))).to_4x4()
    body.hide_render = True
    render(path, 64)
    body.hide_render = False
    json.dump({"centre_m": list(at), "world_from_probe": [list(row) for row in turn @ PROBE_UPRIGHT]}, open(probe, "w"), indent=1)


for folder in ("geometry/cameras", "linear", "truth", "relit/cameras", "relit/linear", "relit/mask"):
    os.makedirs(f"{out}/{folder}", exist_ok=True)
body = make_subject()
bpy.ops.mesh.primitive_cube_add(size=1, location=(0, 0, 1.6))
bpy.context.object.scale = (6.5, 6, 3.2)
bpy.context.object.data.materials.append(material("room", {"Roughness": 1., "Specular": 0., "Base Color": (.25, .24, .22, 1)}))
eye = bpy.data.objects.new("eye", bpy.data.cameras.new("eye"))
scene.collection.objects.link(eye)
scene.camera = eye
json.dump({"world_from_probe": [list(row) for row in PROBE_UPRIGHT]}, open(out + "/start.json", "w"))
open(out + "/unseen.txt", "w").writelines(f"cam{i:03d}.exr\n" for i in range(2, N_VIEWS, 5))

panels = place_lights(5, out + "/truth/lights.json")
axis = Vector([draw.gauss(0, 1) for _ in range(3)]).normalized()
take_panorama(out + "/panorama.exr", out + "/truth/probe.json", middle + Vector([draw.uniform(-.06, .06) for _ in range(3)]),
              Quaternion(axis, math.radians(draw.uniform(6, 12))).to_matrix())
photograph(N_VIEWS, "cam", out + "/linear", out + "/geometry/cameras")
for panel in panels:
    bpy.data.objects.remove(panel)
place_lights(4, out + "/relit/lights.json")
take_panorama(out + "/relit/panorama.exr", out + "/relit/probe.json", middle, Matrix.Identity(3))
photograph(N_RELIT, "relit", out + "/relit/linear", out + "/relit/cameras", out + "/relit/mask")
