"""Objectives whose optimum is known, as :mod:`tk.optim.smd` asks for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from tk.optim.smd import Float, Objective


@dataclass(frozen=True)
class Evaluation:
    value: Float
    gradient: Float
    hessian_vector: Float


def anywhere(poses: Float) -> Float:
    return poses


def box(lower: float, upper: float) -> Callable[[Float], Float]:
    return lambda poses: np.clip(poses, lower, upper)


def bowl(hessian: Float, centre: Float) -> Objective:
    """½ (p − c)ᵀ H (p − c)."""

    def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
        gradient = (poses - centre) @ hessian
        return Evaluation(0.5 * np.sum(gradient * (poses - centre), axis=1), gradient, directions @ hessian)

    return evaluate


def scripted(gradients: Float) -> Objective:
    """Returns ``gradients[iteration]`` (B, D) wherever it is asked; no curvature."""

    def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
        return Evaluation(np.zeros(len(poses)), gradients[iteration], np.zeros_like(poses))

    return evaluate


def rippled(phases: Float, amplitude: float = 0.3, frequency: float = 9.0) -> Objective:
    """Least squares on a sample, as in section 7.1: a row's residuals x + A sin(ωx + φ) have their optimum at 0 in the
    mean over all phases, and spurious local minima elsewhere on any few of them. phases (iterations, B, samples)."""

    def evaluate(poses: Float, directions: Float, iteration: int) -> Evaluation:
        phase = frequency * poses + phases[iteration]
        residual = poses + amplitude * np.sin(phase)
        slope = 1 + amplitude * frequency * np.cos(phase)
        return Evaluation(
            0.5 * np.mean(residual**2, axis=1),
            np.mean(residual * slope, axis=1, keepdims=True),
            np.mean(slope**2, axis=1, keepdims=True) * directions,
        )

    return evaluate


def cliff(poses: Float, directions: Float, iteration: int) -> Evaluation:
    """(x² + 100 y²)²: its gradient grows with the cube of the distance."""
    weights = np.array([1.0, 100.0])
    square = np.sum(weights * poses**2, axis=1, keepdims=True)
    along = np.sum(weights * poses * directions, axis=1, keepdims=True)
    return Evaluation(
        square[:, 0] ** 2,
        4 * square * weights * poses,
        4 * square * weights * directions + 8 * along * weights * poses,
    )
