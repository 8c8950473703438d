"""Record small pictures that every backend must reproduce: `python tests/golden/record.py [--rasterizer torch]`.

Each .npz holds the splats, the camera and the picture (float32), and says which backend made it, with which dtype and
version. The default is gsplat on CUDA, whose numbers all others follow; `torch` records the float64 reference.
"""

import argparse
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))
import scenes  # noqa: E402

from freqgs_plugin.rendering.base import get_rasterizer  # noqa: E402
from freqgs_plugin.types import Camera, Splats  # noqa: E402

SCENES = (("plain", False), ("off_centre", True), ("rotated", True), ("behind", False), ("finished_pixels", False))


def record(name: str, antialiased: bool, rasterizer_name: str) -> None:
    device, dtype = ("cuda", torch.float32) if rasterizer_name == "gsplat" else ("cpu", torch.float64)
    rasterizer = get_rasterizer(rasterizer_name, device)
    scene, view = scenes.awkward()[name]
    # what is stored is float32, so that is what is rendered
    inputs = {k: getattr(scene, k).float() for k in scenes.LEAVES}
    inputs |= {"viewmat": view.viewmat.float(), "K": view.K.float(), "background": torch.tensor([0.1, 0.5, 0.9])}
    moved = {k: v.to(device, dtype) for k, v in inputs.items()}
    rendering = rasterizer(
        Splats(**{k: moved[k] for k in scenes.LEAVES}),
        Camera(moved["viewmat"], moved["K"], view.width, view.height),
        background=moved["background"],
        antialiased=antialiased,
    )
    package = "gsplat" if rasterizer_name == "gsplat" else "torch"
    np.savez_compressed(
        HERE / f"{name}.npz",
        **{k: v.numpy() for k, v in inputs.items()},
        width=view.width,
        height=view.height,
        antialiased=antialiased,
        image=rendering.features.float().cpu().numpy(),
        alpha=rendering.alpha.float().cpu().numpy(),
        depth=rendering.depth.float().cpu().numpy(),
        rasterizer=f"{rasterizer_name}, {str(dtype).removeprefix('torch.')} on {device}, {package} {version(package)}",
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rasterizer", choices=("gsplat", "torch"), default="gsplat")
    arguments = parser.parse_args()
    for name, antialiased in SCENES:
        record(name, antialiased, arguments.rasterizer)
        print(f"recorded {name}.npz with {arguments.rasterizer}")


if __name__ == "__main__":
    main()
