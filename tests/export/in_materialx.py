"""MaterialX' own GLSL renderer, in a process of its own: a ball under one lamp, by the shaders that it generates.

    python in_materialx.py <folder> <size> <x,y,z: towards the lamp> <surface> …

reads m.mtlx and ball.obj in the folder and writes <surface>.npy: [size, size, 3], rows from the bottom; the ball fills it.
"""

import sys
from pathlib import Path

import MaterialX as mx
import numpy as np
from MaterialX import PyMaterialXGenGlsl as glsl
from MaterialX import PyMaterialXGenShader as generation
from MaterialX import PyMaterialXRender as render
from MaterialX import PyMaterialXRenderGlsl as gl


def main(folder: Path, size: int, lamp: np.ndarray, names: list[str]) -> None:
    document, generator = read(folder / "m.mtlx"), glsl.GlslShaderGenerator.create()
    context = generation.GenContext(generator)
    context.registerSourceCodeSearchPath(mx.getDefaultDataSearchPath())
    context.getOptions().hwMaxActiveLightSources = 1
    renderer = gl.GlslRenderer.create(size, size, render.BaseType.FLOAT)
    renderer.initialize()
    renderer.setLightHandler(lights(document, lamp, context))
    renderer.setGeometryHandler(geometry(folder / "ball.obj"))
    renderer.setCamera(camera())
    renderer.setImageHandler(render.ImageHandler.create(render.StbImageLoader.create()))
    for name in names:
        renderer.createProgram(generator.generate(name, document.getChild(name), context))
        renderer.validateInputs()
        renderer.render()
        np.save(folder / f"{name}.npy", pixels(renderer, size))


def read(path: Path) -> mx.Document:
    document, standard = mx.createDocument(), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), standard)
    document.importLibrary(standard)
    mx.readFromXmlFile(document, str(path))
    return document


def lights(document: mx.Document, lamp: np.ndarray, context: generation.GenContext) -> render.LightHandler:
    """One lamp of irradiance π."""
    light = document.addNode("directional_light", "lamp", "lightshader")
    light.setInputValue("direction", mx.Vector3(*(float(v) for v in -lamp / np.linalg.norm(lamp))))
    light.setInputValue("color", mx.Color3(1, 1, 1))
    light.setInputValue("intensity", np.pi)
    handler = render.LightHandler.create()
    handler.setDirectLighting(True)
    handler.setIndirectLighting(False)
    handler.registerLights(document, [light], context)
    handler.setLightSources([light])
    return handler


def geometry(path: Path) -> render.GeometryHandler:
    handler = render.GeometryHandler.create()
    handler.addLoader(render.TinyObjLoader.create())
    handler.loadGeometry(mx.FilePath(str(path)), False)
    return handler


def camera() -> render.Camera:
    found = render.Camera.create()
    found.setViewMatrix(found.createViewMatrix(mx.Vector3(0, 0, 50), mx.Vector3(0, 0, 0), mx.Vector3(0, 1, 0)))
    found.setProjectionMatrix(found.createOrthographicMatrix(-1, 1, -1, 1, 1, 100))
    return found


def pixels(renderer: gl.GlslRenderer, size: int) -> np.ndarray:
    image = render.Image.create(size, size, 4, render.BaseType.FLOAT)
    image.createResourceBuffer()
    image = renderer.captureImage(image)
    colours = [[image.getTexelColor(x, y) for x in range(size)] for y in range(size)]
    return np.array([[[colour[c] for c in range(3)] for colour in row] for row in colours])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), np.array([float(v) for v in sys.argv[3].split(",")]), sys.argv[4:])
