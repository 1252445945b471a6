"""Constants as their sources print them: what ``preset="paper"`` sets.

One data class for each source; its fields are keys of plugins. A key that the user gives goes before its field, and a
plugin takes nothing of the fields whose keys it does not have. What a source does not print has no field and keeps our
default. The page of each plugin lists both values, with the measurement that led from one to the other.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Values of the key ``preset``: our defaults, and the constants as printed.
PRESETS = ("measured", "paper")


@dataclass(frozen=True)
class TwoLevel:
    """Dereviannykh et al. 2025, "Neural Two-Level Monte Carlo Real-Time Rendering", and the authors' published
    configuration (METHODS 1).

    `direction_degree`: spherical harmonics of 25 values, which the authors count as 5 bands, of degree 0 to 4.
    `train_vertices`: records at up to 3 vertices. `train_samples`: -1, one path for each tile of 8x8 pixels.
    """

    inputs: str = "normal, albedo, roughness"
    levels: int = 12
    direction_degree: int = 4
    width: int = 64
    hidden_layers: int = 4
    loss: str = "weighted"
    epsilon: float = 1e-3
    learning_rate: float = 1e-3
    last_rate: float = 1.0
    ema_decay: float = 0.99
    ema_debiased: bool = True
    train_samples: int = -1
    train_vertices: int = 4
    termination: str = "balanced"
    alpha: float = 1.0


@dataclass(frozen=True)
class ReliabilityWeighted:
    """Klepikov et al., "Reliability-Weighted Averaging for Real-Time Neural Incident Radiance Caching", section 3."""

    reliability: str = "correlation"
    reliability_decay: float = 0.9
    reliability_warm_up: int = 128
    reliability_kappa: float = 4.0


@dataclass(frozen=True)
class RadianceCacheGuide:
    """Advanced Micro Devices, "AMD FSR Radiance Caching (Preview)", version 0.9.0, 2025: its inputs, its sample code,
    and the defaults of its two overrides."""

    inputs: str = "normal, view, albedo, roughness"
    spread_threshold: float = 0.01
    learning_rate: float = 0.002
    ema_decay: float = 0.99


@dataclass(frozen=True)
class RadianceCaching:
    """Müller et al. 2021, "Real-time Neural Radiance Caching for Path Tracing", with a hash grid for the position
    (METHODS 2).

    `train_steps`, `train_records`: 4 steps of 16,384 records a frame. `train_samples`: there so many paths as give that
    number in each scene; here half as many paths as records, which suffices where paths have two or more.
    """

    width: int = 64
    hidden_layers: int = 2
    epsilon: float = 0.01
    last_rate: float = 1.0
    ema_debiased: bool = True
    train_steps: int = 4
    train_records: int = 16384
    train_samples: int = 8192
    unbounded_share: float = 1 / 16
    world_share: float = 0.0


@dataclass(frozen=True)
class NeuralVisibility:
    """Bokšanský and Meister 2025, "Neural Visibility Cache for Real-Time Light Sampling", sections 3.2 and 3.3, figure
    5: single lights, and NRC-DI (section 4.2), which has the same network, data and rates.

    `train_samples`: 4096 points in the scene and as many on surfaces that the camera sees.
    """

    train_frames: int = 1
    train_samples: int = 8192
    world_points: float = 0.5
    vertices: int = 1
    loss: str = "squared"
    first_rate: float = 0.05
    last_rate: float = 0.001
    rate_steps: int = 200
    averaging: float = 0.0
    levels: int = 10
    base_resolution: int = 16
    level_scale: float = 2.0
    init: str = "he"
    floor: float = 0.001
    cluster_choice: str = "visibility"
    within: str = "uniform"


@dataclass(frozen=True)
class ClusteredVisibility:
    """What differs there for clusters of lights (section 3.4)."""

    train_samples: int = 49152
    levels: int = 8
    base_resolution: int = 2


@dataclass(frozen=True)
class ReSTIR:
    """The screen-space ReSTIR of Bokšanský and Meister 2025 (section 4.1), the baseline there."""

    initial_candidates: int = 8
    history: float = 20.0
    spatial_radius: float = 32.0


@dataclass(frozen=True)
class ReSTIRWithVisibility:
    """What differs there where candidates come from the visibility cache (sections 3.1 and 4.1.1)."""

    candidate_shadow_ray: bool = False
