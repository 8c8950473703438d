"""Seeded random scenes on which rasterizers are compared; the same numbers on every machine."""

import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from freqgs_plugin.rendering.base import Rasterizer
from freqgs_plugin.types import Camera, Gaussians, Splats

LEAVES = ("means", "quats", "scales", "opacities", "features")
SCENE_SEED, IMAGE_SEED, DETAIL_SEED = 0, 1, 2
DEPTH_STEP = 1 / 4096
"""of the workload with equal depths, world units"""


@dataclass(frozen=True)
class Workload:
    """Splats with colours ready, one view, and the image gradient that is sent back."""

    name: str
    splats: Splats
    camera: Camera
    background: Float[Tensor, " 3"]
    gradient: Float[Tensor, "h w 3"]
    antialiased: bool = False

    @property
    def size(self) -> str:
        return f"{len(self.splats):,} Gaussians, {self.camera.width}x{self.camera.height} px"

    def to(self, device: str, dtype: torch.dtype = torch.float32) -> "Workload":
        """The same workload elsewhere; numbers are not rounded anew when the dtype widens."""
        splats = Splats(*(getattr(self.splats, name).to(device, dtype) for name in LEAVES))
        camera = replace(self.camera, viewmat=self.camera.viewmat.to(device, dtype), K=self.camera.K.to(device, dtype))
        background, gradient = self.background.to(device, dtype), self.gradient.to(device, dtype)
        return replace(self, splats=splats, camera=camera, background=background, gradient=gradient)


NAMES = ("medium", "large", "small splats")


def workload(name: str, quick: bool = False) -> Workload:
    """One of `NAMES`; `quick`: few Gaussians, small images.

    - `medium`: 10,000 Gaussians of 1 to 16 px at 400x300;
    - `large`: 100,000 of the same at 800x600;
    - `small splats`: 110,000 anisotropic ones of 0.01 to 5 px at 648x420, most of which share their exact depth with
      another one, as the points of a real scan do. It stands in for a real scene, which it is not.
    """
    if name == "medium":
        size = (1_000, 160, 120) if quick else (10_000, 400, 300)
        return random_workload(name, *size, size=(0.01, 0.08))
    if name == "large":
        size = (3_000, 200, 150) if quick else (100_000, 800, 600)
        return random_workload(name, *size, size=(0.005, 0.04))
    if name == "small splats":
        return small_splats(name, *((3_000, 162, 105) if quick else (110_000, 648, 420)))
    raise ValueError(f"unknown workload '{name}'; choose one of: {', '.join(NAMES)}.")


def random_workload(name: str, n: int, width: int, height: int, size: tuple[float, float]) -> Workload:
    """n Gaussians at depths 2 to 6 over 1.2 times the view; log-uniform `size`: standard deviations, world units.

    The focal length is the image's width, so larger images show the same Gaussians with more pixels.
    """
    g, focal = torch.Generator().manual_seed(SCENE_SEED), float(width)
    z = torch.rand(n, generator=g) * 4 + 2
    u, v = (_across(torch.rand(n, generator=g), side, focal) for side in (width, height))
    low, high = size
    scales = torch.exp(torch.rand(n, 3, generator=g) * math.log(high / low) + math.log(low))
    splats = Splats(
        means=torch.stack([u * z, v * z, z], -1),
        scales=scales,
        quats=torch.randn(n, 4, generator=g),
        opacities=torch.rand(n, generator=g) * 0.9 + 0.05,
        features=torch.rand(n, 3, generator=g),
    )
    return _viewed(name, splats, focal, width, height)


def small_splats(name: str, n: int, width: int, height: int) -> Workload:
    """n small Gaussians, axes uniform in 0.0001 to 0.02, whose depths are rounded to `DEPTH_STEP`."""
    g, focal = torch.Generator().manual_seed(SCENE_SEED), float(width)
    z = torch.round((torch.rand(n, generator=g) * 4 + 2) / DEPTH_STEP) * DEPTH_STEP
    u, v = (_across(torch.rand(n, generator=g), side, focal) for side in (width, height))
    splats = Splats(
        means=torch.stack([u * z, v * z, z], -1),
        scales=torch.rand(n, 3, generator=g) * (0.02 - 1e-4) + 1e-4,
        quats=torch.nn.functional.normalize(torch.randn(n, 4, generator=g), dim=-1),
        opacities=torch.rand(n, generator=g),
        features=torch.rand(n, 3, generator=g),
    )
    return _viewed(name, splats, focal, width, height)


def _across(share: Tensor, side: int, focal: float) -> Tensor:
    """Slopes over 1.2 times a side of the image from shares in [0, 1]."""
    return (share * 1.2 - 0.6) * side / focal


def _viewed(name: str, splats: Splats, focal: float, width: int, height: int) -> Workload:
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    camera = Camera(torch.eye(4), K, width, height)
    return Workload(name, splats, camera, torch.tensor([0.1, 0.2, 0.3]), image_gradient(camera))


def image_gradient(camera: Camera) -> Float[Tensor, "h w 3"]:
    """Normally distributed."""
    return torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(IMAGE_SEED))


def random_levels(n: int, levels: int) -> Tensor:
    """Levels 1..levels, each as likely as another."""
    g = torch.Generator().manual_seed(DETAIL_SEED)
    return torch.randint(1, levels + 1, (n,), generator=g, dtype=torch.int32)


def with_detail(of: Workload, levels: int) -> Gaussians:
    """The workload's Gaussians with harmonics of degree 3, random levels, and decays log-uniform in 0.1 to 3."""
    g = torch.Generator().manual_seed(DETAIL_SEED)
    s, n = of.splats, len(of.splats)
    sh = torch.randn(n, 16, 3, generator=g) * 0.3
    return Gaussians(
        means=s.means,
        quats=s.quats,
        scales=s.scales,
        opacities=s.opacities,
        features_dc=sh[:, 0].contiguous(),
        features_rest=sh[:, 1:].contiguous(),
        level=random_levels(n, levels),
        decay=torch.exp(torch.rand(n, generator=g) * math.log(30.0)) * 0.1,
    )


def draw(rasterizer: Rasterizer, of: Workload) -> Tensor:
    """The picture, without gradients."""
    with torch.no_grad():
        return _picture(rasterizer, of.splats, of)


def draw_and_differentiate(rasterizer: Rasterizer, of: Workload) -> tuple[Tensor, dict[str, Tensor]]:
    """The picture, and the gradients of its product with `of.gradient` by all of the splats' tensors."""
    leaves = {name: getattr(of.splats, name).detach().clone().requires_grad_() for name in LEAVES}
    picture = _picture(rasterizer, Splats(**leaves), of)
    (picture * of.gradient).sum().backward()
    return picture.detach(), {name: leaf.grad for name, leaf in leaves.items()}


def _picture(rasterizer: Rasterizer, splats: Splats, of: Workload) -> Tensor:
    options = {"background": of.background, "antialiased": of.antialiased}
    return rasterizer(splats, of.camera, depth=False, **options).features


def save_workload(of: Workload, path: Path) -> None:
    """Write the workload for another process."""
    splats = {name: getattr(of.splats, name) for name in LEAVES}
    camera = {name: getattr(of.camera, name) for name in ("viewmat", "K", "width", "height")}
    rest = {name: getattr(of, name) for name in ("name", "background", "gradient", "antialiased")}
    torch.save({"splats": splats, "camera": camera, **rest}, path)


def load_workload(path: Path) -> Workload:
    """What `save_workload` wrote."""
    stored = torch.load(path, weights_only=True)
    return Workload(**{**stored, "splats": Splats(**stored["splats"]), "camera": Camera(**stored["camera"])})
