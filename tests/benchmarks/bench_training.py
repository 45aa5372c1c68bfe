"""How long training takes at paper scale, and how much of it Lightning, validation and logging add to a bare loop.

    python tests/benchmarks/bench_training.py                     # 250,000 views x 300 epochs, on a GPU if there is one
    python tests/benchmarks/bench_training.py --batch 1024 --variant 2d+3d
    python tests/benchmarks/bench_training.py --device cpu --views 20000 --epochs 5 --batch 1024 --hidden 8

The views are random, with about 150 of 900 bins filled, and are made where they are trained on; a view is positive if
it fills many bins, so that there is something to learn. The whole of the train stage runs but for reading the dataset
and binning. Right after it, the bare loop takes the same number of the same steps: batches, loss, Adam. Nothing here
fails on time.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import statistics
import tempfile
import time
from typing import Any

import lightning
import numpy as np
import torch
from lightning.pytorch import LightningModule, Trainer, seed_everything

from wheretolook.dataset.layout import Dataset
from wheretolook.geometry.camera import PinholeCamera
from wheretolook.inputs.channels import CHANNELS, PAPER_VARIANTS
from wheretolook.scorers.mlp.config import MlpConfig
from wheretolook.scorers.mlp.network import NetworkSpec, ViewpointNetwork
from wheretolook.scorers.train_config import TrainConfig
from wheretolook.training.classifier import ViewpointClassifier, weight_penalty, weighted_bce
from wheretolook.training.data import LabelledViews, ViewpointDataModule
from wheretolook.training.fit import EpochRecord, RunLog, fit, home_device
from wheretolook.utils.tracking import start_run
from wheretolook.utils.tracking_config import TrackingConfig

CAMERA = PinholeCamera()
BLOCK = 4096
FILLED = (0.05, 0.28)
"""Least and most share of filled bins: 150 of 900 on average."""


def random_views(number: int, device: str, bins: int, seed: int = 0) -> LabelledViews:
    """Views with random landmarks, about a third of them positive."""
    generator = torch.Generator(device).manual_seed(seed)
    means = torch.empty((number, len(CHANNELS), bins, bins), device=device)
    filled = torch.empty((number, bins, bins), dtype=torch.bool, device=device)
    scale = torch.tensor([150.0, 110.0, 1.0, 0.7, 1.5], device=device)[:, None, None]
    for begin in range(0, number, BLOCK):
        rows = slice(begin, min(begin + BLOCK, number))
        count = rows.stop - begin
        share = torch.rand((count, 1, 1), generator=generator, device=device) * (FILLED[1] - FILLED[0]) + FILLED[0]
        filled[rows] = torch.rand((count, bins, bins), generator=generator, device=device) < share
        means[rows] = torch.randn((count, *means.shape[1:]), generator=generator, device=device)
        means[rows] = (means[rows] + 2) * scale * filled[rows][:, None]
    n_filled = filled.sum((1, 2)).float()
    noisy = n_filled + torch.randn(number, generator=generator, device=device) * 0.05 * bins**2
    labels = (noisy > noisy.quantile(2 / 3) if number < 2**24 else noisy > 0.2 * bins**2).float()
    return LabelledViews(means, filled, labels, np.zeros(number, np.int64), np.arange(number))


def now(device: str) -> float:
    """Seconds, once the device has done what it was told to."""
    if device.startswith("cuda"):
        torch.cuda.synchronize()
    return time.perf_counter()


class TimedLog(RunLog):
    """Notes the seconds that logging takes."""

    seconds = 0.0

    def add(self, epoch: int, metrics: dict[str, float]) -> None:
        start = time.perf_counter()
        super().add(epoch, metrics)
        self.seconds += time.perf_counter() - start


class TimedRecord(EpochRecord):
    """Notes when each epoch's steps and its validation end. The rows carry it, also out of other processes."""

    device = "cpu"

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.times = {"start_s": now(self.device)}

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.times["steps_s"] = now(self.device)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.times["validation_s"] = now(self.device)

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_epoch_end(trainer, pl_module)
        self.rows[-1].update(self.times, end_s=now(self.device), logging_s=getattr(self.run_log, "seconds", 0.0))


def make_network(data: ViewpointDataModule, variant: str) -> ViewpointNetwork:
    config = data.options
    seed_everything(data.config.seed, verbose=False)
    statistics_of_variant = data.statistics.select(PAPER_VARIANTS[variant])
    return ViewpointNetwork(
        NetworkSpec(statistics_of_variant, config.bins, config.layout, config.hidden, config.dropout)
    )


def bare_epochs(data: ViewpointDataModule, variant: str, epochs: int, device: str) -> list[float]:
    """Seconds of each epoch of a plain loop over the same batches."""
    config = data.options
    network = make_network(data, variant).to(device)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate, fused=True)
    loader = data.train_dataloader()
    seconds = []
    for _ in range(epochs):
        start = now(device)
        for means, filled, labels, _ in loader:
            optimizer.zero_grad()
            loss = weighted_bce(network(means, filled), labels, data.class_weights)
            (loss + config.l2 * weight_penalty(network)).backward()
            optimizer.step()
        seconds.append(now(device) - start)
    return seconds


def spread(seconds: list[float]) -> dict[str, float]:
    """Median, least, most and total; the first, which warms up, counts in the total alone if there are others."""
    warm = seconds[1:] or seconds
    return {"median_s": statistics.median(warm), "min_s": min(warm), "max_s": max(warm), "total_s": sum(seconds)}


def measure(args: argparse.Namespace) -> dict[str, Any]:
    accelerator = {"auto": "auto", "cpu": "cpu", "cuda": "gpu"}[args.device]
    options = MlpConfig(epochs=args.epochs, batch_size=args.batch, hidden=tuple(args.hidden))
    config = TrainConfig(methods=(f"mlp-{args.variant}",), devices=args.devices, accelerator=accelerator, mlp=options)
    device = home_device(config)
    start = now(device)
    views = random_views(args.views + args.val_views, device if args.devices == 1 else "cpu", options.bins)
    made = now(device)
    with tempfile.TemporaryDirectory() as folder:
        data = ViewpointDataModule(Dataset(folder, ()), config, options, device=device, progress=False)
        data.use(views, np.arange(len(views)) >= args.views)
        data.channels = PAPER_VARIANTS[args.variant]
        split = now(device)
        tracking = TrackingConfig(folder, "benchmark")
        with start_run(tracking, "benchmark", "train") as (_, run_id):
            opened = now(device)
            record = TimedRecord("train", options, args.progress, TimedLog(tracking, run_id))
            record.device = device
            classifier = ViewpointClassifier(make_network(data, args.variant), options, data.class_weights)
            fit(classifier, data, record, config)
            done = now(device)
    rows = record.rows
    steps = len(data.train_dataloader())
    logging = [row["logging_s"] for row in rows]
    result: dict[str, Any] = {
        "what": "training",
        "device": torch.cuda.get_device_name() if device != "cpu" else platform.processor() or platform.machine(),
        "devices": args.devices,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "lightning": lightning.__version__,
        "variant": args.variant,
        "hidden": list(options.hidden),
        "views": args.views,
        "val_views": args.val_views,
        "batch": args.batch,
        "epochs": len(rows),
        "steps_per_epoch": steps,
        "view_gb": views.n_bytes / 1e9,
        "make_views_s": made - start,
        "split_and_statistics_s": split - made,
        "total_s": done - opened,
        "start_and_end_s": done - opened - (rows[-1]["end_s"] - rows[0]["start_s"]),
        "epoch": spread([row["end_s"] - row["start_s"] for row in rows]),
        "of_which": {
            "steps": spread([row["steps_s"] - row["start_s"] for row in rows]),
            "validation": spread([row["validation_s"] - row["steps_s"] for row in rows]),
            "metrics_and_record": spread([row["end_s"] - row["validation_s"] for row in rows]),
            "logging_total_s": logging[-1],
        },
        "val_average_precision": record.rows[record.kept]["val_average_precision"],
        "peak_host_gb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9,
    }
    if device != "cpu":
        result["peak_gpu_gb"] = torch.cuda.max_memory_allocated() / 1e9
    if args.devices == 1:
        bare = spread(bare_epochs(data, args.variant, args.bare_epochs or args.epochs, device))
        result["bare_loop"] = bare
        result["epoch_over_bare"] = result["epoch"]["median_s"] / bare["median_s"]
        added = result["of_which"]["steps"]["median_s"] - bare["median_s"]
        result["lightning_ms_per_step"] = 1e3 * added / steps
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=250_000, help="training views (default: the paper's 250,000)")
    parser.add_argument("--val-views", type=int, default=10_000, help="validation views (default: 10,000)")
    parser.add_argument("--epochs", type=int, default=300, help="epochs (default: the paper's 300)")
    parser.add_argument("--batch", type=int, default=8192, help="views a step, over all devices (default: 8192)")
    parser.add_argument(
        "--device", choices=["auto", "cpu", "cuda"], default="auto", help="default: GPU if there is one"
    )
    parser.add_argument("--devices", type=int, default=1, help="GPUs or processes; no bare loop if more than 1")
    parser.add_argument(
        "--variant", choices=list(PAPER_VARIANTS), default="2d", help="input of the network (default: 2d)"
    )
    parser.add_argument("--hidden", type=int, nargs="*", default=[300, 300], help="hidden widths (default: 300 300)")
    parser.add_argument("--bare-epochs", type=int, help="epochs of the bare loop (default: as many)")
    parser.add_argument("--progress", action="store_true", help="show the progress bar")
    parser.add_argument("--out", help="also write the JSON to this file")
    args = parser.parse_args()
    text = json.dumps(measure(args), indent=2)
    print(text)
    if args.out:
        with open(args.out, "w") as file:
            file.write(text + "\n")


if __name__ == "__main__":
    main()
