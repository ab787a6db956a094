"""A learner on images beside critics and guiders on the state: encoders by role, random shifts, frames stored once."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN

from sb3_gac import GAC, AsymmetricSAC, preset
from sb3_gac.base.augmentation import shifted
from sb3_gac.envs import History
from sb3_gac.networks.encoders import EntryExtractor, VectorExtractor
from sb3_gac.replay.samples import SequenceSamples
from tests.helpers import Sampled, TwoViewBandit, small_model

FRAME = spaces.Dict(partial=spaces.Box(0, 255, (2, 36, 36), np.uint8), privileged=spaces.Box(-1, 1, (4,), np.float32))
SMALL = {"net_arch": [8], "features_extractor_kwargs": {"cnn_output_dim": 8}}
ON_STATE = {"critic": ["privileged"]}
GUIDED = {"critic": ["privileged"], "guider": ["privileged"]}


def _env():
    return History(Sampled(FRAME, length=6), length=3)


def _model(cls=GAC, role_keys=GUIDED, policy_kwargs=None, **kwargs):
    options = {"batch_size": 8, "buffer_size": 60, "random_shift": 4, "replay_buffer_kwargs": {"frame_stacks": {"partial": 3}}}
    kwargs = {"policy_kwargs": SMALL | (policy_kwargs or {}), "role_keys": role_keys, **options, **kwargs}
    return small_model(_env(), cls=cls, **kwargs)


def _cnns(model):
    """Roles that see images, by networks of convolutions."""
    networks = {role: getattr(model.policy, role) for role in model.policy.roles.all}
    return {role for role, network in networks.items() if any(isinstance(part, NatureCNN) for part in network.modules())}


@pytest.mark.parametrize(
    ("cls", "role_keys", "share", "see_images"),
    [
        (AsymmetricSAC, ON_STATE, False, {"actor"}),
        (GAC, GUIDED, False, {"learner"}),
        (GAC, ON_STATE, False, {"learner", "guider"}),
        (GAC, ON_STATE, True, {"learner", "guider"}),
    ],
)
def test_only_who_reads_images_has_convolutions(cls, role_keys, share, see_images, tmp_path):
    model = _model(cls, role_keys, {"share_features_extractor": share})
    policy = model.policy
    before = {role: [p.clone() for p in getattr(policy, role).parameters()] for role in policy.roles.all}
    model.learn(30)
    assert _cnns(model) == see_images
    for role, parameters in before.items():
        moved = [not th.equal(p, q) for p, q in zip(parameters, getattr(policy, role).parameters(), strict=True)]
        assert all(moved[:2]), f"{role}'s encoder or first layer is trained"
    for critic, target in policy.pairs.values():
        assert all(isinstance(each.features_extractor, VectorExtractor) for each in (critic, target))
    if cls is GAC:
        shared = policy.guider.features_extractor is policy.learner.features_extractor
        assert shared == share
        assert isinstance(policy.guider.rest_extractor, VectorExtractor) == share
    obs = model.get_env().reset()
    model.save(tmp_path / "model")
    loaded = cls.load(tmp_path / "model")
    np.testing.assert_array_equal(*(m.predict({"partial": obs["partial"]}, deterministic=True)[0] for m in (model, loaded)))


def test_a_guider_on_the_state_corrects_the_learner():
    """Its correction is a function of the state; its mean is the learner's, for the same images, plus std times that."""
    policy = _model().learn(20).policy
    obs = {"partial": th.randint(0, 255, (5, 6, 36, 36), dtype=th.uint8), "privileged": th.rand(5, 4)}
    other = {**obs, "partial": th.randint(0, 255, (5, 6, 36, 36), dtype=th.uint8)}
    assert th.equal(policy.guider.distribution(obs).mean, policy.guider.distribution(other).mean)
    both, delta = policy.distributions(obs), policy.guider.distribution(obs).mean
    th.testing.assert_close(both.guider.mean, both.learner.mean + both.learner.log_std.exp() * delta)
    assert not th.allclose(both.learner.mean, policy.distributions(other).learner.mean)


def test_sharing_an_encoder_that_nobody_else_looks_through_is_refused():
    with pytest.raises(ValueError, match=r"share_features_extractor=True would do nothing, since none of .*guider"):
        _model(policy_kwargs={"share_features_extractor": True})


# --- random shifts --------------------------------------------------------------------------------------------------------


def _moves(moved, images):
    """Which shift of up to four pixels made each image what it is."""
    found = []
    for after, before in zip(moved.numpy(), images.numpy(), strict=True):
        padded = np.pad(before, [(0, 0), (4, 4), (4, 4)], mode="edge")
        crops = {(r, c): padded[:, r : r + 36, c : c + 36] for r in range(9) for c in range(9)}
        found.append({shift for shift, crop in crops.items() if np.array_equal(crop, after)})
    assert all(len(shifts) == 1 for shifts in found)
    return [shifts.pop() for shifts in found]


def test_batches_have_shifted_images_and_all_else_as_it_was():
    plain, shifting = (_model(random_shift=pixels, learning_starts=1000).learn(40) for pixels in (0, 4))
    batches = []
    for model in (plain, shifting):
        np.random.seed(1)
        batches.append(model._sample_batch(16))
    was, now = batches
    shifts = [_moves(getattr(now, name)["partial"], getattr(was, name)["partial"]) for name in _PAIR]
    assert shifts[0] != shifts[1], "observations and next ones by numbers of their own"
    assert all(len(set(each)) > 4 for each in shifts)
    for name in _PAIR:
        assert th.equal(getattr(was, name)["privileged"], getattr(now, name)["privileged"])
    assert th.equal(was.rewards, now.rewards)
    stored = shifting.replay_buffer.observations["partial"]
    np.testing.assert_array_equal(stored, plain.replay_buffer.observations["partial"])


_PAIR = ("observations", "next_observations")


def test_a_sequence_is_shifted_as_one():
    images = th.randint(0, 255, (3, 7, 2, 36, 36), dtype=th.uint8)
    nothing = th.zeros(2, 7)
    samples = SequenceSamples({"partial": images, "privileged": th.ones(3, 7, 1)}, nothing, nothing, nothing, nothing)
    moved = shifted(samples, ["partial"], 4).observations["partial"]
    shifts = [_moves(after, before) for after, before in zip(moved, images, strict=True)]
    assert shifts[0] == shifts[1] == shifts[2]
    assert len(set(shifts[0])) > 2


def _channels_last():
    """Of floating-point numbers, which SB3 leaves in their order."""
    image, vector = spaces.Box(0, 1, (40, 40, 3), np.float32), spaces.Box(-1, 1, (2,), np.float32)
    return Sampled(spaces.Dict(partial=image, privileged=vector))


def test_images_with_their_channels_last_are_not_shifted_over_colours(tmp_path):
    """A model of such images may act, as one of an earlier version does."""
    model = small_model(_channels_last(), random_shift=1, policy_kwargs=SMALL)
    with pytest.raises(ValueError, match=r"random_shift=1 needs .* channels first, and \['partial'\] seem to have them last"):
        model.learn(20)
    model.save(tmp_path / "model")
    GAC.load(tmp_path / "model", device="cpu")
    many = spaces.Dict(partial=spaces.Box(0, 1, (48, 40, 44), np.float32), privileged=spaces.Box(-1, 1, (2,), np.float32))
    small_model(Sampled(many), random_shift=1, policy_kwargs=SMALL).learn(3)


@pytest.mark.parametrize(
    ("env", "pixels", "said"),
    [
        (TwoViewBandit, 4, r"random_shift=4 shifts images, but the deployed policy reads \['partial'\], of which none is"),
        (_env, 36, r'random_shift=36 leaves nothing of the entry "partial"'),
        (_env, -1, "random_shift must be an integer >= 0"),
        (_env, 0.5, "random_shift must be an integer >= 0"),
    ],
)
def test_what_can_not_be_shifted_is_refused(env, pixels, said):
    with pytest.raises(ValueError, match=said):
        small_model(env(), random_shift=pixels, policy_kwargs=SMALL)


# --- the images' order in memory ------------------------------------------------------------------------------------------


class Viewed(BaseFeaturesExtractor):
    """A user's encoder that works on images in SB3's order in memory alone."""

    def __init__(self, observation_space):
        super().__init__(observation_space, features_dim=6)

    def forward(self, observations):
        images = observations["partial"]
        return images.view(len(images), 6, -1).mean(dim=-1)


def _first_input(model, observations):
    """What the deployed policy's first convolution gets, and the features that its encoder makes of it."""
    seen = []
    deployed = model.policy.deployed
    first = next(part for part in deployed.modules() if isinstance(part, th.nn.Conv2d))
    handle = first.register_forward_hook(lambda _, inputs, __: seen.append(inputs[0]))
    features = deployed.extract_features(observations, deployed.features_extractor)
    handle.remove()
    return seen[0], features


def test_convolutions_get_channels_side_by_side():
    """Then they take less time on CPUs; the values are SB3's."""
    model = _model()
    images = th.randint(0, 256, (5, 6, 36, 36), dtype=th.uint8)
    given, features = _first_input(model, {"partial": images})
    assert given.is_contiguous(memory_format=th.channels_last)
    assert not given.is_contiguous()
    assert th.equal(given, preprocess_obs(images, spaces.Box(0, 255, (6, 36, 36), np.uint8)))
    cnn = model.policy.deployed.features_extractor.extractors["partial"]
    th.testing.assert_close(features, cnn(images.float() / 255.0), rtol=1e-4, atol=1e-5)


def test_encoders_of_users_get_images_in_sb3s_order():
    classes = {"features_extractor_class": {"learner": Viewed}, "features_extractor_kwargs": {}}
    model = _model(policy_kwargs=classes).learn(30)
    images = th.randint(0, 256, (5, 6, 36, 36), dtype=th.uint8)
    learner = model.policy.learner
    features = learner.extract_features({"partial": images}, learner.features_extractor)
    th.testing.assert_close(features, images.double().div(255.0).unflatten(1, (6, 1)).mean(dim=(2, 3, 4)).float())


# --- all of it ------------------------------------------------------------------------------------------------------------


def test_other_stacks_are_not_resumed_with(tmp_path):
    _model(learning_starts=1000).learn(10).save_checkpoint(tmp_path)
    with pytest.raises(ValueError, match="replay_buffer_kwargs' frame_stacks"):
        GAC.resume(tmp_path, _env(), replay_buffer_kwargs={})


@pytest.mark.parametrize(("name", "cls"), [("asymmetric_sac", AsymmetricSAC), ("gac", GAC)])
def test_the_preset_is_for_images(name, cls):
    arguments = preset("pixels", algorithm=name, task="HalfCheetahPixels", buffer_size=60, batch_size=8, learning_starts=8)
    model = cls("MultiInputPolicy", _env(), device="cpu", seed=0, **arguments)
    model.learn(24)
    assert model._n_updates > 0
    assert _cnns(model) == {model.policy.roles.deployed}
    assert isinstance(model.policy.deployed.features_extractor, EntryExtractor)
    assert "frames of partial" in model.replay_buffer.rows_by_name()
