"""Render exported files in Blender, for benchmarks/exports.py, which calls this program
with the Python of bpy.

python benchmarks/programs/exports_blender.py JOBS.json
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

MM = 1e-3  # the unit of Blender is the metre
# +y up to +z up, as importers of glTF and USD do
UPRIGHT = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))
SKIN_METHODS = {  # method, and factor from the map in mm to the radius in mm
    "translucency": ("RANDOM_WALK_SKIN", 2),
    "mean_free_path": ("RANDOM_WALK", 4 * math.pi),
}


def open_file(path: str):
    """Import a file into an empty scene; returns its mesh."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=path)
    else:
        bpy.ops.wm.usd_import(filepath=path)
    (mesh,) = [item for item in bpy.data.objects if item.type == "MESH"]
    return mesh


def image(nodes, path: Path, space: str):
    node = nodes.new("ShaderNodeTexImage")
    node.image = bpy.data.images.load(str(path))
    node.image.colorspace_settings.name = space
    return node


def connect(mesh, maps: Path, use: list[str]) -> None:
    """Connect maps as README.txt of a bundle describes."""
    tree = mesh.data.materials[0].node_tree
    link = tree.links.new
    (skin,) = [node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"]
    if "albedo" in use:
        link(
            image(tree.nodes, maps / "albedo.exr", "Linear Rec.709").outputs["Color"],
            skin.inputs["Base Color"],
        )
    if "normal" in use:
        scaled = tree.nodes.new("ShaderNodeVectorMath")
        scaled.operation = "MULTIPLY_ADD"
        scaled.inputs[1].default_value = scaled.inputs[2].default_value = (
            0.5,
            0.5,
            0.5,
        )
        link(
            image(tree.nodes, maps / "normal_tangent.exr", "Non-Color").outputs[
                "Color"
            ],
            scaled.inputs[0],
        )
        bent = tree.nodes.new("ShaderNodeNormalMap")
        link(scaled.outputs["Vector"], bent.inputs["Color"])
        link(bent.outputs["Normal"], skin.inputs["Normal"])
    for name in set(use) & set(SKIN_METHODS):
        skin.subsurface_method, factor = SKIN_METHODS[name]
        skin.inputs["Subsurface Weight"].default_value = 1
        skin.inputs["Subsurface Scale"].default_value = factor * MM
        link(
            image(tree.nodes, maps / f"{name}.exr", "Non-Color").outputs["Color"],
            skin.inputs["Subsurface Radius"],
        )
    if "matt" in use:
        matt = tree.nodes.new("ShaderNodeBsdfDiffuse")
        matt.inputs["Color"].default_value = (0.5, 0.5, 0.5, 1)
        link(skin.inputs["Normal"].links[0].from_socket, matt.inputs["Normal"])
        (out,) = [node for node in tree.nodes if node.type == "OUTPUT_MATERIAL"]
        link(matt.outputs["BSDF"], out.inputs["Surface"])


def add(name: str, data):
    item = bpy.data.objects.new(name, data)
    bpy.context.collection.objects.link(item)
    return item


def add_camera(record) -> None:
    """A pinhole camera from its matrices in the frame of the subject."""
    data, (K, width, height) = (
        bpy.data.cameras.new("camera"),
        (record["K"], record["width"], record["height"]),
    )
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = 36
    data.clip_start = 0.01
    data.lens = K[0][0] * data.sensor_width / width
    data.shift_x = (width / 2 - K[0][2]) / width
    data.shift_y = (K[1][2] - height / 2) / width
    turn = UPRIGHT @ Matrix(record["R"]).transposed() @ Matrix.Diagonal((1, -1, -1))
    placed = turn.to_4x4()
    placed.translation = UPRIGHT @ Vector(record["centre"]) * MM
    camera = add("camera", data)
    camera.matrix_world = placed
    bpy.context.scene.camera = camera


def add_light(record) -> None:
    """A point light; Blender's watts are 4 pi times the radiant intensity."""
    data = bpy.data.lights.new("light", "POINT")
    top = max(record["intensity"])
    data.shadow_soft_size = 0
    data.energy = 4 * math.pi * top * MM**2
    data.color = [x / top for x in record["intensity"]]
    add("light", data).location = UPRIGHT @ Vector(record["position"]) * MM


def half_lit(albedo, method: str, radius, blocked: bool) -> None:
    """A plate from above, 20 mm across the picture, half of it in the shadow of a card
    if `blocked`.
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_cube_add(
        size=1, location=(0, 0, -0.025), scale=(0.2, 0.2, 0.05)
    )
    material = bpy.data.materials.new("plate")
    bpy.context.object.data.materials.append(material)
    material.use_nodes = True
    (skin,) = [
        node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"
    ]
    skin.inputs["Base Color"].default_value = (*albedo, 1)
    skin.inputs["Specular IOR Level"].default_value = 0
    skin.inputs["Subsurface Weight"].default_value = 1
    skin.inputs["Subsurface Radius"].default_value = radius
    skin.inputs["Subsurface Scale"].default_value = 1
    skin.subsurface_method = method
    if blocked:
        bpy.ops.mesh.primitive_plane_add(size=1, location=(0.5, 0, 0.05))
        bpy.context.object.visible_camera = bpy.context.object.visible_diffuse = False
    sun = bpy.data.lights.new("sun", "SUN")
    sun.energy = math.pi
    sun.angle = 0
    add("sun", sun)
    data = bpy.data.cameras.new("camera")
    data.type = "ORTHO"
    data.ortho_scale = 0.02
    camera = add("camera", data)
    camera.location = (0, 0, 0.3)
    bpy.context.scene.camera = camera


def write(path: str, width: int, height: int, samples: int) -> None:
    """Render by direct light, because skindb does not follow light between parts of the
    face either.
    """
    scene = bpy.context.scene
    scene.render.engine, cycles = "CYCLES", scene.cycles
    cycles.device = "CPU"
    cycles.samples = samples
    cycles.max_bounces = 0
    cycles.use_adaptive_sampling = cycles.use_denoising = False
    cycles.pixel_filter_type = "BOX"
    scene.render.film_transparent = True
    (
        scene.render.resolution_x,
        scene.render.resolution_y,
        scene.render.resolution_percentage,
    ) = width, height, 100
    layer = scene.view_layers[0]
    layer.use_pass_normal = layer.use_pass_position = layer.use_pass_diffuse_color = (
        True
    )
    settings = scene.render.image_settings
    settings.media_type = "MULTI_LAYER_IMAGE"  # of Blender 5
    settings.file_format, settings.color_depth, scene.render.filepath = (
        "OPEN_EXR_MULTILAYER",
        "32",
        path,
    )
    bpy.ops.render.render(write_still=True)


def main() -> None:
    """Render all jobs of a file."""
    for job in json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")):
        if "plate" in job:
            half_lit(**job["plate"])
        else:
            connect(open_file(job["file"]), Path(job["maps"]), job["use"])
            add_camera(job["camera"])
            add_light(job["light"])
        write(job["out"], *job["size"], job["samples"])


if __name__ == "__main__":
    main()
