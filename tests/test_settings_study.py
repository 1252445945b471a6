"""`studies/settings.py`: the command on films of a few pixels."""

import json

import numpy as np
from load_study import load_study

study = load_study("settings")


def test_command_compares_settings_after_equal_training(tmp_path, capsys, variant):
    arguments = ["cornell_box", "--size", "12x12", "--spp", "4", "--seeds", "2", "-D", "max_depth=3",
                 "--reference-spp", "16", "-i", "path", "-i", "nrc:train_samples=256", "--variant", variant,
                 "-o", str(tmp_path)]  # fmt: skip
    assert study.main([*arguments, "--paths", "512,1024"]) == 0
    records = json.loads((tmp_path / "settings.json").read_text())["records"]
    path, half, whole = records
    assert (path["label"], path["paths"], path["steps"]) == ("path", 0, 0)
    assert [(r["paths"], r["steps"]) for r in (half, whole)] == [(512, 2), (1024, 4)]
    assert whole["train_cpu_seconds"] > half["train_cpu_seconds"] > 0 and whole["deviations"]["relmse"] > 0
    assert all(0.3 < r["mean"] < 2 and r["relmse"] > 0 and "relmse_denoised" not in r for r in records)
    assert [f.name for f in tmp_path.glob("*.exr")] == ["reference_cornell_box_12x12_16.exr"], "of the scene's depth"
    assert "nrc:train_samples=256" in capsys.readouterr().out
    assert study.main(["nowhere", *arguments[1:]]) == 2 and "no scene file" in capsys.readouterr().err


def test_images_do_not_train(monkeypatch):
    integrator, scene, calls = study.build_integrator(study.parse_integrator("nirc"), {})[0], object(), []

    class Judge:
        def errors(self, image):
            return {"mean": float(np.mean(image))}

    integrator.train = lambda scene, n, **_: calls.append(n)
    frozen = []

    def rendered(*_):
        frozen.append(integrator.freeze_cache)
        return study.budget.Rendered(np.zeros((1, 1, 3)), {}, 1, 0, 0.0, 0.0)

    monkeypatch.setattr(study.budget, "render_samples", rendered)
    study.measure(scene, integrator, Judge(), [10, 30], [1, 4], seeds=1, images=2, paths=False)
    assert calls == [10, 20] and frozen == [True] * 8 and integrator.freeze_cache is False
