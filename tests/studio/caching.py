"""What a datamanager holds, to compare with another."""

import torch


def files(tmp_path):
    return sorted((tmp_path / "cache").rglob("*.view"))


def everything(manager):
    """Batches and cameras of both splits, in order."""
    found = []
    for views, dataset in ((manager.cached_train, manager.train_dataset), (manager.cached_eval, manager.eval_dataset)):
        cameras = dataset.cameras
        found.append([{k: v.clone() if torch.is_tensor(v) else v for k, v in view.items()} for view in views])
        found.append([torch.as_tensor(getattr(cameras, n)) for n in ("fx", "fy", "cx", "cy", "width", "height")])
    return found


def equal(one, other):
    if torch.is_tensor(one):
        return one.dtype == other.dtype and one.shape == other.shape and torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[k], other[k]) for k in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    return one == other
