"""`ihbench train-mini`: an interrupted training ends like an uninterrupted one, and its backbone can be loaded."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from ihbench import config_fields, registry
from ihbench.cli import main
from ihbench.clock.progress import Progress
from ihbench.clock.threads import one_torch_thread
from ihbench.diffusion.crops import crop_dataset
from ihbench.diffusion.crops.crop_dataset import CropDataset
from ihbench.diffusion.crops.part_map import NO_PART
from ihbench.diffusion.mini import batches as mini_batches
from ihbench.diffusion.mini import model as mini_model
from ihbench.diffusion.mini import train_mini
from ihbench.diffusion.mini import validation as mini_validation
from ihbench.diffusion.mini import weights as mini_weights
from ihbench.diffusion.mini.train_mini import MiniTrainer, curve_of
from ihbench.diffusion.mini.training import MiniTraining
from ihbench.diffusion.mini.weights import load_mini, save_mini
from ihbench.errors import BadInput
from tests.conftest import contents
from tests.diffusion.tiny_diffusion import same, tiny_backbone, weights

QUIET = Progress.silent()
SIDE = 64  # px


def without_bounds(patch: pytest.MonkeyPatch) -> None:
    """Two people are fewer than anybody may ask for."""
    for bound in (config_fields.Within, config_fields.MultipleOf):
        patch.setattr(bound, "holds", lambda self, number: True)


with pytest.MonkeyPatch.context() as patch:
    without_bounds(patch)
    SMALL = MiniTraining(people=2, each=2, steps=4, batch=3)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Two people a page, tiny networks and crops."""
    without_bounds(monkeypatch)
    monkeypatch.setattr(mini_model, "CHANNELS", (32, 32, 32))
    for module in (crop_dataset, train_mini, mini_validation):
        monkeypatch.setattr(module, "PAGE", 2)
    for module in (mini_model, mini_batches, train_mini, mini_weights):
        monkeypatch.setattr(module, "SIZE", SIDE)
    monkeypatch.setattr(mini_validation, "PEOPLE", 2)
    with one_torch_thread():
        yield


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return tmp_path_factory.mktemp("dataset")


class Killed(Exception):
    pass


def test_killed_and_resumed_ends_the_same(tmp_path, dataset, monkeypatch):
    whole = MiniTrainer(SMALL, tmp_path / "whole", dataset, QUIET)
    whole.run()
    part = MiniTrainer(SMALL, tmp_path / "part", dataset, QUIET)
    honest = part._one_step

    def step(batch):
        if part.step == 2:
            part.save()
            raise Killed
        return honest(batch)

    monkeypatch.setattr(part, "_one_step", step)
    with pytest.raises(Killed):
        part.run()
    again = MiniTrainer(SMALL, tmp_path / "part", dataset, QUIET)
    assert again.step == 2
    again.run()
    for name in train_mini.TRAINED:
        assert same(weights(again.modules[name]), weights(whole.modules[name])), name
    assert [row["step"] for row in curve_of(tmp_path / "part")] == [4]


def test_moments_come_back_in_the_memory_format_of_their_parameters(tmp_path, dataset, monkeypatch):
    """On a GPU convolutions are channels last, and the fused optimiser refuses moments that are not."""
    trainer = MiniTrainer(SMALL, tmp_path, dataset, QUIET)
    trainer._one_step(trainer.batches[0])
    trainer.step = 1
    trainer.save()
    honest = MiniTrainer._restore

    def on_a_gpu(self):
        self.modules["unet"].to(memory_format=torch.channels_last)
        honest(self)

    monkeypatch.setattr(MiniTrainer, "_restore", on_a_gpu)
    again = MiniTrainer(SMALL, tmp_path, dataset, QUIET)
    for name, p in again.named.items():
        state = again.optimizer.state.get(p, {})
        kept = trainer.optimizer.state.get(trainer.named[name], {})
        assert state.keys() == kept.keys()
        for key, value in state.items():
            torch.testing.assert_close(value, kept[key], rtol=0, atol=0)
            assert value.dim() != 4 or value.stride() == p.stride(), name
    assert any(p.dim() == 4 and not p.is_contiguous() for p in again.named.values())
    again._one_step(again.batches[1])


def test_worker_processes_make_the_same_batches(tmp_path, dataset):
    batches = MiniTrainer(SMALL, tmp_path, dataset, QUIET).batches
    for step, made in enumerate(batches.stream(0, 3, workers=2)):
        own = batches[step]
        assert made.noise_seed == own.noise_seed
        assert torch.equal(made.hidden, own.hidden)
        assert torch.equal(made.ids, own.ids)


def test_half_precision_arithmetic_is_close(tmp_path, dataset):
    full = MiniTrainer(SMALL, tmp_path / "full", dataset, QUIET)
    half = MiniTrainer(replace(SMALL, precision="bfloat16"), tmp_path / "half", dataset, QUIET)
    batch = full.batches[0]
    with torch.no_grad():
        expected, found = full.loss(batch).item(), half.loss(batch).item()
    assert found != expected
    assert found == pytest.approx(expected, rel=0.02)


def test_another_configuration_does_not_go_on(tmp_path, dataset):
    trainer = MiniTrainer(SMALL, tmp_path, dataset, QUIET)
    trainer._one_step(trainer.batches[0])
    trainer.step = 1
    trainer.save()
    with pytest.raises(BadInput, match="other lr"):
        MiniTrainer(replace(SMALL, lr=1e-3), tmp_path, dataset, QUIET)
    assert MiniTrainer(replace(SMALL, steps=9), tmp_path, dataset, QUIET).step == 1
    (tmp_path / train_mini.STATE).write_bytes(b"damaged")
    with pytest.raises(BadInput, match="not a readable training state"):
        MiniTrainer(SMALL, tmp_path, dataset, QUIET)


def test_a_training_starts_from_an_earlier_backbone(tmp_path, dataset):
    earlier = MiniTrainer(SMALL, tmp_path / "earlier", dataset, QUIET)
    save_mini(earlier.backbone, tmp_path / "folder")
    later = MiniTrainer(replace(SMALL, seed=5), tmp_path / "later", dataset, QUIET, start=tmp_path / "folder")
    for name in (*train_mini.TRAINED, "codec"):
        for key, value in weights(getattr(earlier.backbone, name)).items():
            found = weights(getattr(later.backbone, name))[key]
            torch.testing.assert_close(found, value, atol=1e-3, rtol=1e-3)  # saved in 16 bit
    torch.testing.assert_close(later.channel_weight, earlier.channel_weight)
    save_mini(tiny_backbone(), tmp_path / "other")
    with pytest.raises(BadInput, match="--start: a backbone that knows other words"):
        MiniTrainer(SMALL, tmp_path / "never", dataset, QUIET, start=tmp_path / "other")


def test_people_come_in_pages(tmp_path, dataset):
    with pytest.raises(BadInput, match="multiple of 2"):
        MiniTrainer(MiniTraining(people=3, each=2), tmp_path, dataset, QUIET)


def test_the_loss_sees_the_prompted_traits(tmp_path, dataset):
    """Trait tokens reach the text encoder's output of told prompts alone."""
    trainer = MiniTrainer(MiniTraining(people=2, each=2, traits=1.0, captions=0.0), tmp_path, dataset, QUIET)
    traits, people = torch.from_numpy(trainer.batches.crops.traits), torch.tensor([0, 1])
    words = replace(trainer.batches[0], traits=traits, people=people)
    prompts, told = trainer.batches.words(np.random.default_rng(0), np.array([0, 1]))
    assert told == [True, True]
    words = replace(words, ids=trainer.backbone.token_ids(prompts))
    both = trainer._text(replace(words, told=torch.tensor(told)))
    assert not torch.equal(both[0], both[1])
    alike = replace(words, traits=traits[:1].expand(2, -1), told=torch.tensor(told))
    both = trainer._text(alike)
    assert torch.equal(both[0], both[1])
    with torch.no_grad():
        trainer.tokens.own.weight[1] = 0.1  # a person is more than their traits
    both = trainer._text(alike)
    assert not torch.equal(both[0], both[1])
    both = trainer._text(replace(words, told=torch.tensor([False, False])))
    assert torch.equal(both[0], both[1])


def test_of_a_dropped_context_little_is_left(tmp_path, dataset):
    config = MiniTraining(people=2, each=2, batch=6, context_dropped=1.0, seen=1.0)
    trainer = MiniTrainer(config, tmp_path, dataset, QUIET)
    batch = trainer.batches[0]
    assert not batch.seen.any()
    shown = (batch.person & ~batch.hidden).sum((1, 2)) / batch.person.sum((1, 2))
    assert shown.max() < 0.35
    whole = MiniTrainer(replace(config, context_dropped=0.0), tmp_path / "whole", dataset, QUIET).batches[0]
    assert whole.seen.any()
    seen = whole.seen[..., 3] > 0
    assert not (seen & (whole.labels == NO_PART)).any()  # the surface is the body's


def test_steps_with_heads_and_steps_with_persons(tmp_path, dataset):
    """A share of the steps paints heads alone, from a blurred beginning; the features of a face weigh more."""
    config = replace(SMALL, heads=1.0)
    trainer = MiniTrainer(config, tmp_path / "heads", dataset, QUIET)
    batch = trainer.batches[0]
    assert batch.fills is not None
    assert batch.guides is not None
    assert batch.images.shape[1:3] == (SIDE // 2, 3 * SIDE // 8)
    assert len(batch.images) == 4 * SMALL.batch
    there = batch.person & batch.hidden
    begun, truth = batch.fills[there].float(), batch.images[there].float()
    assert 1 < (begun - truth).abs().mean() < 60
    assert np.isfinite(trainer.loss(batch).item())
    heavier = MiniTrainer(replace(config, feature_weight=50.0), tmp_path / "faces", dataset, QUIET)
    assert heavier.loss(batch).item() != pytest.approx(trainer.loss(batch).item(), rel=1e-4)
    persons = MiniTrainer(replace(SMALL, heads=0.0), tmp_path / "persons", dataset, QUIET).batches
    assert all(persons[step].guides is None for step in range(4))
    assert trainer.backbone.heads
    assert not MiniTrainer(replace(SMALL, heads=0.0), tmp_path / "none", dataset, QUIET).backbone.heads
    mixed = trainer.batches
    mixed.config = replace(SMALL, heads=0.5)
    assert {mixed[step].guides is None for step in range(12)} == {True, False}


def test_a_backbone_that_knew_the_part_map_alone_can_be_trained_on(tmp_path, dataset, monkeypatch):
    """Its guide's new channels weigh nothing at first: it answers as before."""
    monkeypatch.setattr(mini_model, "GUIDE_CHANNELS", 3)
    narrow = mini_model.new_mini(registry.load("people", "procedural").vocabulary(), 0)
    save_mini(narrow, tmp_path / "narrow")
    monkeypatch.setattr(mini_model, "GUIDE_CHANNELS", 7)
    trainer = MiniTrainer(SMALL, tmp_path / "new", dataset, QUIET, start=tmp_path / "narrow")
    earlier = load_mini(tmp_path / "narrow")
    guide = torch.rand(1, 7, SIDE, SIDE)
    noisy = torch.rand(1, earlier.codec.channels, SIDE // 4, SIDE // 4)
    condition = torch.rand(1, 1 + earlier.codec.channels, SIDE // 4, SIDE // 4)
    asked = (noisy, torch.tensor([10]), condition, earlier.text(["a photo of a person"]).detach(), guide)
    for network in (earlier.controlnet, trainer.backbone.controlnet):
        torch.nn.init.ones_(network.controlnet_mid_block.weight)  # of zeros before any training
    with torch.no_grad():
        torch.testing.assert_close(trainer.backbone.predict(*asked), earlier.predict(*asked))


def test_an_album_is_made_where_processes_cannot_share_memory(tmp_path, monkeypatch):
    def refuses(*_, **__):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(crop_dataset, "ProcessPoolExecutor", refuses)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    store = CropDataset(tmp_path, "procedural", 2, SIDE)
    store.make(0, 4, QUIET)
    assert len(list(store.pages(0, 4))) == 2


def test_albums_are_made_by_processes_that_begin_afresh(tmp_path, monkeypatch):
    """A fork of this one, which has torch's and numba's threads, would wait for them forever."""
    asked = []

    def threads(workers, context, initializer):
        asked.append((workers, context.get_start_method(), initializer))
        return ThreadPoolExecutor(1)

    monkeypatch.setattr(crop_dataset, "ProcessPoolExecutor", threads)
    monkeypatch.setattr("os.cpu_count", lambda: 8)
    store = CropDataset(tmp_path, "procedural", 2, SIDE)
    store.make(0, 4, QUIET)
    assert asked == [(2, "spawn", crop_dataset._begin_worker)]
    assert [page.person.tolist() for page in store.pages(0, 4)] == [[0, 0, 1, 1]] * 2
    store.make(0, 6, QUIET)
    assert len(asked) == 1, "one page is not worth a process"


def test_album_pages_are_written_whole_and_read_back(tmp_path):
    store = CropDataset(tmp_path, "procedural", 2, SIDE)
    store.make(0, 2, QUIET)
    (page,) = store.pages(0, 2)
    fresh = crop_dataset.make_page("procedural", 0, 2, 2, SIDE)
    assert (page.images == fresh.images).all()
    assert page.phrases == fresh.phrases
    assert set(page.widths) <= {SIDE // 2, 5 * SIDE // 8, 3 * SIDE // 4, SIDE}
    store.path(0).write_bytes(b"cut short")
    with pytest.raises(BadInput, match="not a readable page"):
        list(store.pages(0, 2))
    with pytest.raises(BadInput, match="pages of 2"):
        store.make(1, 2, QUIET)


class TestWeights:
    def test_saved_and_loaded_within_half_precision(self, tmp_path):
        backbone = tiny_backbone()
        before = weights(backbone.unet)
        save_mini(backbone, tmp_path)
        assert same(weights(backbone.unet), before)
        loaded = load_mini(tmp_path)
        for name, value in before.items():
            torch.testing.assert_close(weights(loaded.unet)[name], value, atol=1e-3, rtol=1e-3)
        assert torch.equal(loaded.token_ids(["a photo of person"]), backbone.token_ids(["a photo of person"]))
        assert loaded.scheduler.config.prediction_type == "sample"
        assert loaded.prefill
        assert not any(p.requires_grad for p in loaded.unet.parameters())

    def test_saving_and_loading_print_nothing(self, tmp_path, capfd):
        save_mini(tiny_backbone(), tmp_path)
        load_mini(tmp_path)
        assert capfd.readouterr() == ("", "")

    def test_a_folder_that_lacks_parts(self, tmp_path):
        with pytest.raises(BadInput, match="lacks unet, controlnet"):
            load_mini(tmp_path)

    @pytest.mark.parametrize(
        ("part", "change", "said"),
        [
            ("unet", lambda w: w.pop("conv_out.weight"), "tensors are missing (conv_out.weight)"),
            ("text_encoder", lambda w: w.pop(next(n for n in w if "token_embedding" in n)), "1 of"),
            ("codec", lambda w: w.pop("scale"), "tensors are missing (scale)"),
            ("controlnet", lambda w: w.update(more=torch.ones(3)), "not of this model (more)"),
            ("unet", lambda w: w.update({"conv_in.bias": torch.ones(3)}), "another shape (conv_in.bias"),
            ("unet", lambda w: w["conv_in.bias"].fill_(float("nan")), "NaN or infinite"),
        ],
    )
    def test_weights_are_never_made_up(self, tmp_path, part, change, said):
        save_mini(tiny_backbone(), tmp_path)
        (file,) = (tmp_path / part).glob("*.safetensors")
        tensors = load_file(file)
        change(tensors)
        save_file(tensors, file)
        with pytest.raises(BadInput) as caught:
            load_mini(tmp_path)
        assert said in str(caught.value)

    @pytest.mark.parametrize("part", ["unet", "text_encoder", "tokenizer", "scheduler"])
    def test_a_damaged_file(self, tmp_path, part):
        save_mini(tiny_backbone(), tmp_path)
        names = ("*.safetensors", "tokenizer.json", "scheduler_config.json")
        (file,) = [file for name in names for file in (tmp_path / part).glob(name)]
        file.write_bytes(b"xx")
        with pytest.raises(BadInput, match=f"{part}.*not a (whole|readable)"):
            load_mini(tmp_path)

    def test_pickles_are_refused(self, tmp_path):
        save_mini(tiny_backbone(), tmp_path)
        (file,) = (tmp_path / "unet").glob("*.safetensors")
        file.rename(file.with_suffix(".bin"))
        with pytest.raises(BadInput, match="only pickles, which are refused"):
            load_mini(tmp_path)

    @pytest.mark.parametrize(
        ("part", "changes", "said"),
        [
            ("unet", {"in_channels": 9}, "in_channels is 9, expected 49"),  # Stable Diffusion's
            ("unet", {"cross_attention_dim": 768}, "cross_attention_dim is 768, expected 128"),
            ("controlnet", {"in_channels": 4}, "in_channels is 4, expected 24"),
            ("codec", {"_class_name": "AutoencoderKL"}, "AutoencoderKL, expected BlockTransform"),
            ("codec", {"luma": None}, "expected the numbers luma and chroma"),
            ("text_encoder", {"vocab_size": 5}, "words, but the text encoder has 5"),
        ],
    )
    def test_parts_of_another_model(self, tmp_path, part, changes, said):
        save_mini(tiny_backbone(), tmp_path)
        file = tmp_path / part / "config.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | changes))
        with pytest.raises(BadInput) as caught:
            load_mini(tmp_path)
        assert said in str(caught.value)


def test_the_command_trains_validates_and_writes_a_card(tmp_path, capsys, monkeypatch, dataset):
    monkeypatch.setattr(mini_validation, "STEPS", (1,))
    words = ["train-mini", "--out", str(tmp_path), "--dataset", str(dataset), "--json", "--train.people", "2"]
    words += ["--train.each", "2", "--train.steps", "2"]
    assert main(words) == 0
    result = json.loads(capsys.readouterr().out)
    assert {
        "mean visible colour, silhouette given",
        "push-pull, silhouette given",
        "mini, 1 steps, noise 0, with parts",
        "hidden face, as it begins",
        "hidden face, mini, 6 steps, noise 0",
    } <= set(result["hidden_psnr"])
    assert all(np.isfinite(value) for value in result["hidden_psnr"].values())
    card = (tmp_path / "README.md").read_text()
    assert "--train.people 2" in card
    assert load_mini(tmp_path).name == "mini"


@pytest.mark.parametrize("start", [False, True])
def test_another_model_of_the_same_folders_is_not_written_over(tmp_path, capsys, dataset, start):
    """Stable Diffusion has a `unet` too; and the backbone to start from is nobody's place to train in."""
    out = tmp_path / "model"
    if start:
        save_mini(tiny_backbone(), out)
    else:
        (out / "unet").mkdir(parents=True)
        (out / "unet" / "config.json").write_text('{"_class_name": "UNet2DConditionModel"}')
    before = contents(out)
    words = [
        "train-mini",
        "--out",
        str(out / "." if start else out),
        "--dataset",
        str(dataset),
        "--train.people",
        "2",
    ]
    assert main([*words, *(("--start", str(out)) if start else ())]) == 2
    assert "folder" in capsys.readouterr().err
    assert contents(out) == before


def test_help_lists_the_commands_of_methods(capsys):
    assert main(["--help"]) == 0
    assert "train-mini" in capsys.readouterr().out


def test_a_method_that_cannot_be_loaded_does_not_take_the_help_away(capsys, monkeypatch):
    def load(kind, name):
        raise BadInput(f"{kind} {name!r} cannot be loaded")

    monkeypatch.setattr("ihbench.cli.registry.load", load)
    assert main(["--help"]) == 0
    assert "exit status" in capsys.readouterr().out
