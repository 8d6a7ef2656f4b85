"""The page of a lens_opt run: layouts, spots, frames, event frames, curves, junction table."""

import numpy as np
import torch

from codesign import events, render
from codesign.errors import MissingPackageError
from codesign.report import chain_figures, lens_figures
from scenes import worlds
from studies.lens_opt.task import FIELDS, PITCH_MM, SENSOR


def blank_wall():
    """A wall without texture: the negative control."""
    return worlds.wall(np.full((64, 64), 60.0, dtype=np.float32), texel_m=0.003)


def write(run, job, lenses, history, junctions, found):
    """Fill and finish the run's page."""
    m = run.metrics
    task = job.task
    case = job.probe
    record = job.loop.record
    run.card(
        "Flow error, hard events",
        f"{m['flow_error_mrad_hard_optimised']:.2f} mrad",
        f"detuned {m['flow_error_mrad_hard_detuned']:.2f}, nominal {m['flow_error_mrad_hard_nominal']:.2f}",
    )
    run.card(
        "Flow recovered",
        f"{100 * m['flow_error_recovered_share']:.0f} %",
        "of what the detuning lost, on unseen textures and motions",
    )
    run.card(
        "RMS spot",
        f"{m['rms_spot_um_optimised']:.1f} µm",
        f"detuned {m['rms_spot_um_detuned']:.1f}, nominal {m['rms_spot_um_nominal']:.1f}; a pixel is "
        f"{PITCH_MM * 1e3:g} µm",
    )
    run.card(
        "Focal length held",
        f"{m['efl_mm_optimised']:.4f} mm",
        f"detuned {m['efl_mm_detuned']:.4f} mm, f/{m['fno_optimised']:.2f}",
    )
    run.section(
        "The lens",
        "Detuned and optimised lens with meridional rays at the three fields; the published design, scaled "
        "to the sensor, for comparison.",
    )
    run.figure(
        lens_figures.layouts(lenses, task.fields_rad),
        "lens_layout",
        "Cross-sections; light comes from the left. Colours are fields 0, 0.7 and 1 of the half diagonal.",
    )
    run.figure(
        lens_figures.spot_diagrams(lenses, task.fields_rad, PITCH_MM),
        "spot_diagrams",
        "Spots at 587.6 nm about their mean; the red square is one pixel.",
    )
    run.section(
        "What the sensor sees",
        "One training scene through the detuned and the optimised lens: first frame and signed event counts "
        "over the whole interval, at the three windows.",
    )
    run.figure(
        _seen(task, lenses, case, run.config.samples),
        "frames_and_events",
        "Top of each pair: frame; below: ON minus OFF events (red minus blue).",
    )
    _seed_emulator(run, task, lenses["optimised"], case)
    run.section("The way there")
    done = list(range(1, len(record.loss) + 1))
    losses = {
        "each step, its own cases": (done, record.loss),
        "fixed training cases, hard sensor": (record.judged_step, record.score),
    }
    run.figure(
        chain_figures.curves(losses, _loss_label(run.config.objective)),
        "loss_curve",
        "Loss while optimising.",
    )
    run.figure(
        chain_figures.curves(
            {
                f"field {h:g}": (record.judged_step, [row[k] for row in history.spot_um])
                for k, h in enumerate(FIELDS)
            },
            "RMS spot (µm)",
        ),
        "spot_curve",
        "RMS spot of the best design so far.",
    )
    for name, unit in (("curvature", "1/mm"), ("thickness", "mm")):
        rows = np.array(getattr(history, name))
        series = {
            f"surface {k + 1}": (record.judged_step, rows[:, k] - rows[0, k]) for k in range(rows.shape[1])
        }
        run.figure(
            chain_figures.curves(series, f"change of {name} ({unit})"),
            f"{name}_curves",
            f"Change of each {name} since the detuned start; the last curvature holds the focal length.",
        )
    run.section(
        "Gradient at every junction",
        "One pass at the end point: norms of value and gradient, and the share of gradient entries that are "
        "exactly zero.",
    )
    run.table(
        "Junctions",
        ["junction", "value norm", "gradient norm", "zero share"],
        [[r["junction"], r["value_norm"], r["gradient_norm"], r["zero_share"]] for r in junctions],
    )
    run.section(
        "Judged on held-out cases",
        "Hard events from the physical sensor, textures and motions never optimised on; the control is a "
        "wall without texture, where no lens can help.",
    )
    rows = [
        [i + 1, *(round(found[name][i]["flow_error_mrad"], 3) for name in lenses)]
        for i in range(len(found["nominal"]))
    ]
    run.table("Angular flow error per case (mrad)", ["case", *lenses], rows)
    run.table(
        "Means",
        ["lens", "flow error (mrad)", "RMS spot (µm)", "edge energy", "events per pixel"],
        [
            [
                n,
                m[f"flow_error_mrad_hard_{n}"],
                m[f"rms_spot_um_{n}"],
                m[f"edge_energy_hard_{n}"],
                m[f"events_per_pixel_hard_{n}"],
            ]
            for n in lenses
        ],
    )
    control = f"Control without texture: detuned {m['flow_error_mrad_hard_control_detuned']:.2f} mrad, optimised {m['flow_error_mrad_hard_control_optimised']:.2f} mrad."
    run.text(control)
    config = run.config
    trained = ", the network trained with the lens" if config.train_network else ""
    pace = f" at {m['seconds_per_step']:.2f} s" if "seconds_per_step" in m else ""
    lead = (
        f"{config.lens}, seed {config.seed}, objective {config.objective}, events {config.events}, flow "
        f"{config.flow}{trained}: {m['steps']} steps{pace}."
    )
    run.finish("Lens optimisation for event flow", lead)
    run.say(
        f"flow error {m['flow_error_mrad_hard_detuned']:.3f} -> {m['flow_error_mrad_hard_optimised']:.3f} "
        f"mrad (nominal {m['flow_error_mrad_hard_nominal']:.3f}), "
        f"RMS spot {m['rms_spot_um_detuned']:.1f} -> {m['rms_spot_um_optimised']:.1f} um (nominal "
        f"{m['rms_spot_um_nominal']:.1f})"
    )


def _seed_emulator(run, task, optics, case):
    """The seed project's view of the same scene: naive frame-difference events as CSV, and their
    exponential-decay video."""
    with torch.no_grad():
        frames = render.frames(
            task.camera(optics, run.config.samples, case.seed), case.scene, case.T_world_body
        )
    tall = frames.reshape(frames.shape[0], -1, frames.shape[-1])  # the windows above one another
    stream = events.naive(tall, case.t_s, SENSOR.theta_on)
    events.write(run.path("events_naive.csv"), stream)
    try:
        events.decay_video(run.path("events_decay.mp4"), stream, case.t_s, 0.015, fps=8)
    except MissingPackageError as error:
        run.text(f"**Left out**: the video of fading events. {error}")
        run.say(f"left out: the video of fading events; {error}")
        return
    run.video(
        "events_decay.mp4",
        f"{len(stream)} events of the naive frame-difference emulator (events_naive.csv), fading over 15 "
        "ms; the three windows above one another.",
    )


def _loss_label(objective):
    return "mean log angular error (log mrad)" if objective == "flow" else "−(edge energy − λ activity)"


def _seen(task, lenses, case, samples):
    rows = []
    labels = []
    signed = []
    for name in ("detuned", "optimised"):
        with torch.no_grad():
            camera = task.camera(lenses[name], samples, case.seed)
            frames = render.frames(camera, case.scene, case.T_world_body)
            counts, _ = events.memory(frames, SENSOR.theta_on, SENSOR.theta_off)
        total = counts.sum(0)
        rows += [list(frames[0].numpy()), list((total[0] - total[1]).numpy())]
        labels += [f"{name}: frame", f"{name}: events"]
        signed += [False, True]
    return chain_figures.strips(rows, [f"field {h:g}" for h in FIELDS], signed, labels)
