"""What a damaged file has lost of a run, as the cause of what its data lack."""

from __future__ import annotations

from math import inf

from handfast.deploy.analysis.gaps import GAP_S, gap_s
from handfast.deploy.recording.recording import Damage, Recording
from handfast.deploy.verdict.gaps.missing_poses import Gap


def cut_short(recording: Recording) -> Damage | None:
    """The damage after which nothing of the drive is there any more, None without any."""
    stopped_s = recording.stopped_s
    until_s = recording.planned_s if stopped_s is None else stopped_s
    return next(
        (each for each in recording.damage if each.end_s == inf and each.start_s < until_s - GAP_S), None
    )


def reasons(recording: Recording, worst: Gap | None) -> list[str]:
    """The sentence that fails the verdict, if something is lost that it needs.

    Args:
        worst: of the gaps that it made and that matter, what weighs most.
    """
    cut = cut_short(recording)
    if cut is not None and cut.start_s == -inf:
        return [f"The recording is damaged: {cut.file} has lost parts throughout, so the drive is not known."]
    if cut is not None:
        return [
            f"The recording is damaged: {cut.file} ends at {max(cut.start_s, 0.0):.2f} s, in the midst of a "
            f"drive of {recording.planned_s:.1f} s, so nothing is known after that."
        ]
    if worst is None:
        return []
    near_s = gap_s(recording)
    spans = [
        each
        for each in recording.damage
        if each.start_s - near_s <= worst.start_s and worst.end_s <= each.end_s + near_s
    ]
    start_s, end_s = max(0.0, spans[0].start_s), spans[0].end_s
    until = "the end" if end_s == inf else f"{end_s:.2f} s"
    stake = ""
    if worst.stake is not None and worst.stake.may_be_broken:
        stake = f": robot {worst.robot} {worst.stake.words}"
    return [
        f"The recording is damaged: {spans[0].file} has lost what came from {start_s:.2f} s to {until}, so "
        f"nothing is known of that time{stake}."
    ]
