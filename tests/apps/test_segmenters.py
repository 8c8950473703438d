"""Masks from text: the seam for segmenters, and CLIPSeg from end to end with tiny random weights."""

import json
import socket
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from freqgs_plugin.apps import segmenters
from freqgs_plugin.apps.masks import MaskError
from freqgs_plugin.apps.segmenters import (
    ENTRY_POINT_GROUP,
    Segmenter,
    SegmenterError,
    available_segmenters,
    get_segmenter,
    prompt_masks,
)

IMAGE = torch.rand(20, 30, 3, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A folder with a CLIPSeg of random weights, and a tokenizer of letters."""
    from transformers import (
        CLIPSegConfig,
        CLIPSegForImageSegmentation,
        CLIPSegProcessor,
        CLIPTokenizer,
        ViTImageProcessor,
    )

    folder = tmp_path_factory.mktemp("clipseg")
    letters = "abcdefghijklmnopqrstuvwxyz"
    vocabulary = [*letters, *(c + "</w>" for c in letters), "re", "red</w>", "<|startoftext|>", "<|endoftext|>"]
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("#version: 0.2\nr e\nre d</w>\n")
    tokenizer = CLIPTokenizer(str(folder / "vocab.json"), str(folder / "merges.txt"), model_max_length=16)
    last = len(vocabulary) - 1
    small = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 3, "num_attention_heads": 2}
    tokens = {"bos_token_id": last - 1, "eos_token_id": last, "pad_token_id": last, "max_position_embeddings": 16}
    config = CLIPSegConfig(
        text_config={**small, **tokens, "vocab_size": len(vocabulary)},
        vision_config={**small, "image_size": 32, "patch_size": 8},
        projection_dim=16,
        extract_layers=[0, 1, 2],
        reduce_dim=8,
        decoder_num_attention_heads=2,
        decoder_intermediate_size=16,
    )
    torch.manual_seed(0)
    CLIPSegForImageSegmentation(config).save_pretrained(folder)
    CLIPSegProcessor(ViTImageProcessor(size={"height": 32, "width": 32}), tokenizer).save_pretrained(folder)
    return folder


@pytest.fixture
def no_network(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("the network was asked")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


def test_clipseg_finds_something_for_a_prompt(tiny, no_network):
    segmenter = get_segmenter("clipseg", weights=tiny)
    assert isinstance(segmenter, Segmenter)
    red, blue = (segmenter(IMAGE.numpy(), prompt) for prompt in ("red", "a blue ball"))
    assert red.shape == (20, 30) and 0 <= red.min() < red.max() <= 1
    assert np.abs(red - blue).max() > 1e-3, "the prompt matters"
    assert np.array_equal(segmenter(IMAGE.numpy(), "red"), red), "the same each time"
    other = segmenter(IMAGE.flip(1).numpy(), "red")
    assert np.abs(red - other).max() > 1e-3, "the image matters"
    threshold = float(np.median(red))
    (mask,) = prompt_masks(segmenter, [IMAGE], "red", threshold)
    assert torch.equal(mask, torch.from_numpy(red > threshold)) and 0 < mask.sum() < mask.numel()


def test_clipseg_is_the_models_own_answer(tiny):
    """Nothing is resized for an image of the model's size, and its logits are the probabilities' log-odds."""
    from transformers import CLIPSegForImageSegmentation, CLIPSegProcessor

    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(1))
    answer = get_segmenter("clipseg", weights=tiny)(image.numpy(), "red")
    processor, model = (c.from_pretrained(tiny) for c in (CLIPSegProcessor, CLIPSegForImageSegmentation))
    inputs = processor(text=["red"], images=[(image.numpy() * 255).round().astype(np.uint8)], return_tensors="pt")
    with torch.no_grad():
        logits = model.eval()(**inputs).logits.reshape(32, 32)
    torch.testing.assert_close(torch.from_numpy(answer), logits.sigmoid(), rtol=1e-5, atol=1e-6)


def test_missing_weights_are_named(tiny, tmp_path, no_network):
    with pytest.raises(SegmenterError, match=r"nobody/none.* neither a folder nor in the cache.*allow_download=True"):
        get_segmenter("clipseg", weights="nobody/none")
    with pytest.raises(SegmenterError, match="holds no complete CLIPSeg model"):
        get_segmenter("clipseg", weights=tmp_path)
    for file in tiny.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    weights = tmp_path / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(SegmenterError, match="holds no complete CLIPSeg model"):
        get_segmenter("clipseg", weights=tmp_path)


def test_weights_that_are_left_out_are_not_made_up(tiny, tmp_path):
    from safetensors.torch import load_file, save_file

    for file in tiny.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    weights = load_file(tmp_path / "model.safetensors")
    save_file(
        {k: v for k, v in weights.items() if "decoder" not in k}, tmp_path / "model.safetensors", {"format": "pt"}
    )
    with pytest.raises(SegmenterError, match=r"\d+ weights are missing"):
        get_segmenter("clipseg", weights=tmp_path)


def test_without_transformers_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(SegmenterError, match=r"pip install 'freqgs-plugin\[prompt\]'"):
        get_segmenter("clipseg")


def test_the_network_is_asked_only_on_request(monkeypatch):
    asked = []

    class Fake:
        @classmethod
        def from_pretrained(cls, name, **options):
            asked.append((name, options["local_files_only"]))
            raise OSError("not there")

    monkeypatch.setattr("freqgs_plugin.apps.clipseg._classes", lambda: (Fake, Fake))
    for allow, message in ((False, "nothing is downloaded unasked"), (True, "could not be downloaded")):
        with pytest.raises(SegmenterError, match=message):
            get_segmenter("clipseg", weights="some/name", allow_download=allow)
    assert asked == [("some/name", True), ("some/name", False)]


def test_others_are_registered_by_entry_point(monkeypatch):
    made = []
    entry = SimpleNamespace(name="mine", load=lambda: lambda **options: made.append(options) or brightness)
    monkeypatch.setattr(segmenters, "entry_points", lambda group: [entry] if group == ENTRY_POINT_GROUP else [])
    assert available_segmenters() == ["clipseg", "mine"]
    assert get_segmenter("mine", size=3) is brightness and made == [{"size": 3}]
    with pytest.raises(ValueError, match=r"unknown segmenter 'other'. Choose one of: clipseg, mine\."):
        get_segmenter("other")


def brightness(image, prompt):
    return image.mean(-1) if prompt == "light" else np.zeros(image.shape[:2], np.float32)


def test_a_mask_is_what_is_above_the_threshold():
    images = [IMAGE, torch.zeros(7, 9, 3)]
    masks = prompt_masks(brightness, images, "light", 0.6)
    torch.testing.assert_close(masks[0], IMAGE.mean(-1) > 0.6)
    assert masks[0].any() and masks[1].shape == (7, 9) and not masks[1].any()


def test_bad_prompts_and_answers_are_named():
    with pytest.raises(MaskError, match=r"'dark' was found in none of 1 images: the highest probability is 0\.000"):
        prompt_masks(brightness, [IMAGE], "dark")
    with pytest.raises(ValueError, match="the prompt is empty"):
        prompt_masks(brightness, [IMAGE], "  ")
    for threshold in (0.0, 1.0):
        with pytest.raises(ValueError, match=f"threshold is {threshold}"):
            prompt_masks(brightness, [IMAGE], "light", threshold)
    with pytest.raises(MaskError, match="there is no image"):
        prompt_masks(brightness, [], "light")
    with pytest.raises(SegmenterError, match=r"the shape \(20,\) for an image of \(20, 30\)"):
        prompt_masks(lambda image, _: image.mean((1, 2)), [IMAGE], "light")
    with pytest.raises(SegmenterError, match="600 of the segmenter's probabilities are not finite"):
        prompt_masks(lambda image, _: image.mean(-1) * np.nan, [IMAGE], "light")
