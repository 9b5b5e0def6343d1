"""A checkpoint gives back exactly what was saved, to the run that saved it and to no other."""

import pytest
import torch

from neuma_lib.io.checkpoint import Checkpoint
from tests.support.errors import refused

pytestmark = pytest.mark.core


def test_training_resumes_bit_for_bit(tmp_path):
    """Killed after any number of iterations and resumed, a noisy training ends with the same weights."""

    def train(checkpoint, stop=None):
        torch.manual_seed(0)
        model = torch.nn.Linear(4, 4)
        optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
        scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 10)
        first = 0
        if (state := checkpoint.load()) is not None:
            first = state["iteration"]
            for part, name in ((model, "model"), (optimizer, "optimizer"), (scheduler, "scheduler")):
                part.load_state_dict(state[name])
        for iteration in range(first, 10):
            if iteration == stop:
                return None
            optimizer.zero_grad()
            model(torch.randn(8, 4)).square().sum().backward()
            optimizer.step()
            scheduler.step()
            parts = {"model": model, "optimizer": optimizer, "scheduler": scheduler}
            states = {name: part.state_dict() for name, part in parts.items()}
            checkpoint.save({"iteration": iteration + 1, **states})
        return model.weight.detach().clone()

    whole = train(Checkpoint(tmp_path / "whole.pt", {"code": 1}))
    killed = Checkpoint(tmp_path / "killed.pt", {"code": 1})
    assert train(killed, stop=6) is None
    torch.manual_seed(123)
    assert torch.equal(train(killed), whole)


def test_absent_and_removed(tmp_path):
    checkpoint = Checkpoint(tmp_path / "deep" / "state.pt", {})
    assert checkpoint.load() is None
    checkpoint.save({"iteration": 1})
    assert checkpoint.load() == {"iteration": 1}
    checkpoint.remove()
    checkpoint.remove()
    assert checkpoint.load() is None
    assert list((tmp_path / "deep").iterdir()) == []


def test_other_settings_are_refused(tmp_path):
    path = tmp_path / "state.pt"
    Checkpoint(path, {"setting lr": 0.1, "code": "a"}).save({"iteration": 1})
    with refused(path, problem="setting lr (was 0.1, is 0.2)", remedy="rm '") as error:
        Checkpoint(path, {"setting lr": 0.2, "code": "a"}).load()
    assert "code" not in error.value.problem
    assert path.exists()


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"not a checkpoint"])
def test_damaged_file_is_named(tmp_path, damage):
    path = tmp_path / "state.pt"
    Checkpoint(path, {}).save({"x": torch.zeros(100)})
    path.write_bytes(damage(path.read_bytes()))
    with refused("state.pt", remedy="rm '"):
        Checkpoint(path, {}).load()


def test_a_failing_save_keeps_the_old_state(tmp_path):
    checkpoint = Checkpoint(tmp_path / "state.pt", {})
    checkpoint.save({"iteration": 1})
    with pytest.raises(Exception, match="pickle"):
        checkpoint.save({"iteration": lambda: 2})
    assert checkpoint.load() == {"iteration": 1}
    assert [p.name for p in tmp_path.iterdir()] == ["state.pt"]
