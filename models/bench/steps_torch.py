"""The networks in PyTorch eager: what ONNX Runtime is compared with. Random weights: they take the same time."""

import numpy as np
import torch
import torch.nn.functional as F
from steps_opencv import Clock

from sthn.lite import coarse, refine
from sthn.network import NetworkConfig, Sthn
from sthn.network.resize import resize_satellite


class Light:
    """The light network: correlation, then patches."""

    def __init__(self, manifest: dict) -> None:
        torch.manual_seed(0)
        self.stage, self.refine_stage = manifest["coarse"], manifest.get("refine")
        net = coarse.CoarseNet((16, 32, 64, 96)).eval()
        self.coarse_map, self.coarse = coarse.MapSide(net), coarse.FrameSide(net)
        self.refine_map = self.refine = None
        if self.refine_stage:
            sizes = self.refine_stage["map"]["size_px"], self.refine_stage["frame"]["size_px"]
            net = refine.RefineNet(*sizes).eval()
            self.refine_map, self.refine = refine.MapSide(net), refine.Matcher(net)

    def run(self, window_rgb: np.ndarray, crop: np.ndarray | None) -> dict[str, float]:
        """Milliseconds by step for one window and its frame."""
        clock = Clock()
        spec, frame_px = self.stage["map"], self.stage["frame"]["size_px"]
        hypotheses = len(self.stage["rotations_deg"]) * len(self.stage["scales"])
        frames = _frame(hypotheses, frame_px)
        with torch.inference_mode():

            def encode_map() -> torch.Tensor:
                planes = torch.from_numpy(window_rgb).permute(2, 0, 1)[None].float() / 255.0
                return self.coarse_map(F.interpolate(planes, size=(spec["size_px"],) * 2, mode="bilinear", antialias=True))

            def correlate(features: torch.Tensor, frame_features: torch.Tensor) -> torch.Tensor:
                surfaces = coarse.correlate_all(features, frame_features)
                return torch.log_softmax(surfaces.flatten(), 0)

            features = clock("coarse_map", encode_map)
            frame_features = clock("coarse", self.coarse, frames)
            clock("correlate", correlate, features, frame_features)
            if self.refine is not None:
                features = clock("refine_map", self.refine_map, torch.from_numpy(crop))
                clock("refine", self.refine, features, _frame(1, self.refine_stage["frame"]["size_px"]))
        return clock.taken_ms


class Published:
    """The published architecture."""

    def __init__(self, manifest: dict) -> None:
        torch.manual_seed(0)
        self.side = manifest["coarse"]["map"]["size_px"]
        padding = round(manifest["refine"]["crop"]["padding_m"])
        config = NetworkConfig(self.side, int(manifest["window_width_m"]), 4, 6, 6, padding, True)
        self.net = Sthn(config).eval()

    def run(self, window_rgb: np.ndarray, crop: np.ndarray | None) -> dict[str, float]:
        """Milliseconds by step for one window and its frame."""
        clock = Clock()
        frame = torch.rand(1, 3, self.side, self.side)
        with torch.inference_mode():

            def encode_map() -> torch.Tensor:
                planes = torch.from_numpy(window_rgb).permute(2, 0, 1)[None].float() / 255.0
                return self.net.netG.encode(resize_satellite(planes, self.side))

            def match(net: torch.nn.Module, features: torch.Tensor) -> torch.Tensor:
                return net.match(features, net.encode(frame))

            features = clock("coarse_map", encode_map)
            clock("coarse", match, self.net.netG, features)
            features = clock("refine_map", self.net.netG_fine.encode, torch.from_numpy(crop))
            clock("refine", match, self.net.netG_fine, features)
        return clock.taken_ms


def _frame(count: int, size_px: int) -> torch.Tensor:
    """Gray and mask."""
    return torch.cat([torch.rand(count, 1, size_px, size_px), torch.ones(count, 1, size_px, size_px)], 1)
