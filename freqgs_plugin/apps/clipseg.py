"""Segmentation from text by CLIPSeg (Lüddecke and Ecker 2022), through `transformers`: the extra `prompt`."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch.nn.functional import interpolate

from freqgs_plugin.apps.segmenters import MissingWeightsError, SegmenterError
from freqgs_plugin.io.images import to_uint8

WEIGHTS = "CIDAS/clipseg-rd64-refined"
"""on the Hugging Face hub; the weights that its authors recommend"""


class CLIPSeg:
    """A `Segmenter`. Weights come from a folder, or from the cache of the Hugging Face hub.

    The network is asked only with `allow_download`, once; then the weights lie in the cache.
    """

    def __init__(
        self, weights: str | Path = WEIGHTS, *, allow_download: bool = False, device: torch.device | str = "cpu"
    ) -> None:
        """Load the weights.

        Args:
            weights: a folder with a model and its processor as `save_pretrained` writes them, or a name on the hub.
            allow_download: fetch weights that are not in the cache.
            device: where to compute.

        Raises:
            SegmenterError: transformers is not installed, or the weights cannot be had.
        """
        processor_class, model_class = _classes()
        options = {"local_files_only": not allow_download}
        try:
            self._processor: Any = processor_class.from_pretrained(str(weights), **options)
            model, found = model_class.from_pretrained(str(weights), output_loading_info=True, **options)
        # what the libraries raise for damaged files shares no class with the rest
        except Exception as error:
            raise _missing(weights, allow_download) from error
        if found["missing_keys"]:
            # transformers makes up what it does not find
            raise _missing(weights, allow_download, f"{len(found['missing_keys'])} weights are missing: ")
        self._model: Any = model.eval().to(device)
        self._device = torch.device(device)

    @torch.no_grad()
    def __call__(self, image: Float[np.ndarray, "h w 3"], prompt: str) -> Float[np.ndarray, "h w"]:
        """Probability of what `prompt` describes; the model's own answer is coarser than the image."""
        inputs = self._processor(text=[prompt], images=[to_uint8(image)], padding=True, return_tensors="pt")
        logits = self._model(**inputs.to(self._device)).logits.float()
        logits = logits.reshape(1, 1, *logits.shape[-2:])
        probability = interpolate(logits, size=image.shape[:2], mode="bilinear", align_corners=False).sigmoid()
        return probability[0, 0].cpu().numpy()


def _classes() -> tuple[Any, Any]:
    """Processor and model; transformers takes seconds to import."""
    try:
        from transformers import CLIPSegForImageSegmentation, CLIPSegProcessor
    except ImportError as error:
        raise SegmenterError(
            "CLIPSeg needs the package transformers, which cannot be imported: pip install 'freqgs-plugin[prompt]'"
        ) from error
    return CLIPSegProcessor, CLIPSegForImageSegmentation


def _missing(weights: str | Path, allow_download: bool, before: str = "") -> MissingWeightsError:
    if Path(weights).is_dir():
        return MissingWeightsError(
            f"{before}the folder {weights} holds no complete CLIPSeg model; it needs what `save_pretrained` of the "
            "model and of its processor write: config.json, model.safetensors, the image processor's and the "
            "tokenizer's files."
        )
    if allow_download:
        return MissingWeightsError(
            f"{before}the CLIPSeg weights '{weights}' could not be downloaded; check the name and the network."
        )
    return MissingWeightsError(
        f"{before}the CLIPSeg weights '{weights}' are neither a folder nor in the cache of the Hugging Face hub.",
        "As nothing is downloaded unasked, pass weights=FOLDER with a saved model, or allow_download=True.",
    )
