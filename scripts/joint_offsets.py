"""Print the constants of the expected error (tk/model/body/expected_error.py, `offset_m` in tk/model/body/joints.py).

    python -m scripts.joint_offsets walk.h5 CAPTURES/walk/truth.h5 dance.h5 CAPTURES/dance/truth.h5 …

The offset of a joint is its median error in the trunk's frame, which `tk evaluate` removes. Printed are the mean length
of the offset of each kind of joint, and then, with these, how the raw mean errors divided by the expected ones are
distributed: the 90 % prediction interval (Student, of the logarithms) of the mean of all joints, and 5 and 95 % of the
means of single joints. With several people in a file, each is a recording.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.stats import t

from tk.evaluation.joints import Evaluation, evaluate
from tk.evaluation.people import evaluate_people
from tk.io.results.reader import joint_tracks, read_people, read_result
from tk.model.body.expected_error import MEAN_LENGTH, Float
from tk.model.body.joints import JOINTS, ROWS


def recordings(result: str, truth: str) -> Iterator[tuple[Evaluation, Float]]:
    """Yield the evaluation of each person of the truth, and sigma (F, J) of the frames with a pose, cm."""
    found, true = read_result(result), read_people(truth)
    sigmas = [100 * person.in_joint_order().sigma[person.has_pose] for person in found.people]
    if len(sigmas) == len(true) == 1:
        yield evaluate(joint_tracks(found)[0], true[0]), sigmas[0]
        return
    for person in evaluate_people(joint_tracks(found), true).people:
        if person.errors is not None:
            yield person.errors, sigmas[person.matched_with[0]]


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", metavar="RESULT TRUTH")
    files = parser.parse_args(arguments).files
    if len(files) % 2:
        parser.error("each result needs its truth")
    named = [
        (name, *one) for name, truth in zip(files[::2], files[1::2], strict=True) for one in recordings(name, truth)
    ]
    lengths = np.array([np.linalg.norm([found.offsets_cm[j] for j in JOINTS], axis=1) for _, found, _ in named])
    kinds = np.array([ROWS[joint].kind for joint in JOINTS])
    offset = np.array([lengths[:, kinds == kind].mean() for kind in kinds])
    for kind in dict.fromkeys(kinds):
        print(f"offset_m of {kind:9} {offset[kinds == kind][0] / 100:.3f}")
    expected = [np.sqrt(MEAN_LENGTH * sigma**2 + offset**2) for _, _, sigma in named]
    raw = np.array([[found.raw.joints[joint].mean_cm for joint in JOINTS] for _, found, _ in named])
    for (name, found, _), length, one in zip(named, lengths, expected, strict=True):
        means = f"offset {length.mean():.2f}, raw error {found.raw.all.mean_cm:.2f}, expected {np.nanmean(one):.2f}"
        print(f"{name}: {means} cm")
    ratio = np.log(
        [found.raw.all.mean_cm / np.nanmean(one) for (_, found, _), one in zip(named, expected, strict=True)]
    )
    reach = t.ppf(0.95, len(ratio) - 1) * ratio.std(ddof=1) * np.sqrt(1 + 1 / len(ratio))
    joints = raw / np.array([np.nanmean(one, axis=0) for one in expected])
    print(
        "error / expected: all joints {:.2f} to {:.2f};".format(*np.exp(ratio.mean() + reach * np.array([-1, 1]))),
        end=" ",
    )
    print("one joint {:.2f} to {:.2f};".format(*np.quantile(joints, (0.05, 0.95))), f"{len(named)} recordings")


if __name__ == "__main__":
    main()
