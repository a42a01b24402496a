# config/blender/import_studiorig.py - a folder of `rigsolve export --formats blender` into Blender (3.0 to 4.x).
#
#   blender --python import_studiorig.py -- DIR [--lights] [--no-model]
#
# or open it in Blender's text editor and call load("DIR"). Positions, up axis and lights stay in the studio's world, metres.
# Up to 3.6 the Principled BSDF is Burley's and takes the layers as they are, with two exceptions: his "subsurface" only changes the
# shape of the diffuse lobe, Blender's scatters light under the skin, so it is left at 0; clearcoatGloss becomes the roughness of the
# same lobe, sqrt(.1 - .099 gloss). From 4.0 on sheen and coat are other models: what is there is the nearest, and it is said so.
import json
import math
import os
import sys

import bpy
from mathutils import Vector


def socket(node, *names):
    for name in names:
        if name in node.inputs:
            return node.inputs[name]
    return None


class Builder:
    def __init__(self, folder, material):
        self.folder = folder
        self.tree = material.node_tree
        self.row = 0

    def image(self, file, color):
        node = self.tree.nodes.new("ShaderNodeTexImage")
        node.image = bpy.data.images.load(os.path.join(self.folder, file), check_existing=True)
        names = [item.name for item in node.image.colorspace_settings.bl_rna.properties["name"].enum_items]
        linear = [name for name in ("Linear", "Linear Rec.709") if name in names]
        node.image.colorspace_settings.name = linear[0] if color and linear else "Non-Color"
        node.extension = "EXTEND"
        node.location = (-700, 300 - 280 * self.row)
        self.row += 1
        return node.outputs["Color"]

    def math(self, operation, a, b):
        node = self.tree.nodes.new("ShaderNodeMath")
        node.operation = operation
        for i, value in enumerate((a, b)):
            self.connect(value, node.inputs[i])
        return node.outputs[0]

    def connect(self, value, target):
        if isinstance(value, (int, float)):
            target.default_value = value
        else:
            self.tree.links.new(value, target)


def build_material(folder, layers):
    material = bpy.data.materials.new("studiorig")
    material.use_nodes = True
    b = Builder(folder, material)
    shader = next(n for n in material.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
    shader.distribution = "GGX"
    old = bpy.app.version < (4, 0, 0)
    value = {name: v if isinstance(v, (int, float)) else b.image(v, name == "albedo") for name, v in layers.items()}
    b.connect(value["albedo"], shader.inputs["Base Color"])
    b.connect(value["metallic"], shader.inputs["Metallic"])
    b.connect(value["roughness"], shader.inputs["Roughness"])
    b.connect(value["specular"], socket(shader, "Specular", "Specular IOR Level"))
    b.connect(value["anisotropic"], shader.inputs["Anisotropic"])
    b.connect(value["sheen"], socket(shader, "Sheen", "Sheen Weight"))
    b.connect(value["clearcoat"] if old else b.math("MULTIPLY", value["clearcoat"], 0.25), socket(shader, "Clearcoat", "Coat Weight"))
    gloss = value["clearcoatGloss"]
    if isinstance(gloss, (int, float)):
        rough = math.sqrt(0.1 - 0.099 * gloss)
    else:
        rough = b.math("SQRT", b.math("SUBTRACT", 0.1, b.math("MULTIPLY", gloss, 0.099)), 0.0)
    b.connect(rough, socket(shader, "Clearcoat Roughness", "Coat Roughness"))
    if old:
        b.connect(value["specularTint"], shader.inputs["Specular Tint"])
        b.connect(value["sheenTint"], shader.inputs["Sheen Tint"])
    else:
        print("studiorig: Blender %d.%d: sheen, coat and tints are not Burley's any more; tints are left out" % bpy.app.version[:2])
    subsurface = socket(shader, "Subsurface", "Subsurface Weight")
    subsurface.default_value = 0
    tangent = b.tree.nodes.new("ShaderNodeTangent")  # anisotropy runs along u
    tangent.direction_type = "UV_MAP"
    b.tree.links.new(tangent.outputs["Tangent"], shader.inputs["Tangent"])
    return material


def import_mesh(path):
    before = set(bpy.data.objects)
    if hasattr(bpy.ops.wm, "obj_import"):
        bpy.ops.wm.obj_import(filepath=path, forward_axis="Y", up_axis="Z")
    else:
        bpy.ops.import_scene.obj(filepath=path, axis_forward="Y", axis_up="Z", split_mode="OFF")
    return [o for o in bpy.data.objects if o not in before and o.type == "MESH"]


def add_lights(path):
    """A light of the solve is a small Lambertian emitter that faces the probe: irradiance E at its distance r
    needs 4 E r^2 of what Blender calls watts (an area light of W shines W / 4 per steradian along its axis; measured, 3.4)."""
    with open(path) as file:
        lights = json.load(file)
    n = 0
    for i, light in enumerate(lights):
        most = max(light["irradiance"])
        if most <= 0 or "dir_world" not in light:
            continue
        direction = Vector(light["dir_world"])
        if light["distance_m"] is None:
            data = bpy.data.lights.new("light%03d" % i, "SUN")
            data.energy = most
            data.angle = 0
            place = direction * 10
        else:
            data = bpy.data.lights.new("light%03d" % i, "AREA")
            data.shape = "DISK"
            data.size = 0.01
            data.energy = 4 * most * light["distance_m"] ** 2
            place = Vector(light["pos_m"])
        data.color = [c / most for c in light["irradiance"]]
        thing = bpy.data.objects.new(data.name, data)
        thing.location = place
        thing.rotation_mode = "QUATERNION"
        thing.rotation_quaternion = direction.to_track_quat("Z", "Y")  # emits along -Z, to the probe
        bpy.context.scene.collection.objects.link(thing)
        n += 1
    return n


def load(folder, model=True, lights=False):
    folder = os.path.abspath(folder)
    with open(os.path.join(folder, "export.json")) as file:
        layers = json.load(file).get("material")
    if not layers:
        raise SystemExit("studiorig: %s/export.json has no material: rigsolve export --formats blender" % folder)
    if model:
        material = build_material(folder, layers)
        for thing in import_mesh(os.path.join(folder, "model.obj")):
            thing.data.materials.clear()
            thing.data.materials.append(material)
    path = os.path.join(folder, "lights.json")
    if lights and os.path.exists(path):
        print("studiorig: %d lights" % add_lights(path))


if __name__ == "__main__" and "--" in sys.argv:
    arguments = sys.argv[sys.argv.index("--") + 1:]
    folders = [a for a in arguments if not a.startswith("--")]
    if len(folders) != 1:
        raise SystemExit("usage: blender --python import_studiorig.py -- DIR [--lights] [--no-model]")
    load(folders[0], "--no-model" not in arguments, "--lights" in arguments)
