"""Settings of models, which say how networks are made. Those of a user's own are
``package.module:Name``."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from damian.common.fields import Settings, setting
from damian.common.registry import Registry, resolved

if TYPE_CHECKING:
    from torch import nn

    from damian.server.layout import Layout


def _is_model(found: Any) -> bool:
    derived = isinstance(found, type) and issubclass(found, ModelConfig)
    return derived and found.make_network is not ModelConfig.make_network


MODELS = Registry[type["ModelConfig"]](
    "model",
    _is_model,
    "is not a @dataclass derived from damian.ModelConfig with a method make_network",
)
"""Settings of models, by name; the user's own as ``package.module:Name``."""


@dataclass
class ModelConfig(Settings):
    """Settings of the networks of actor and critics; those that all models share.

    A model of your own has a dataclass derived from this class, with fields for its own settings,
    that implements ``make_network``, from which actor, critic and action values are made. A memory,
    a prior, and networks for each UAV combine with it. ``model=package.module:Name``
    chooses it.
    """

    section: ClassVar[str] = "model"

    name: str = setting(
        "mlp", "Name of the model, or package.module:Name; the group ``model`` sets it."
    )
    hidden: list[int] = setting([256, 256], "Width of each hidden layer.", low=1, high=16384)
    activation: str = setting(
        "tanh", "Activation function.", choices=("tanh", "relu", "elu", "silu")
    )
    rnn: str = setting(
        "none",
        "Recurrence: with gru the actor's last hidden layer remembers its observations of the "
        "episode.",
        choices=("none", "gru"),
    )
    prior: bool = setting(
        False,
        "The actor begins by preferring actions of high ``belief_gain``, or else of high ``gain`` "
        "among ``observation.actions``.",
    )
    shared: bool = setting(
        True, "All UAVs share one actor; if not, each has one of its own, for unequal UAVs."
    )
    shared_value: bool = setting(
        False, "MAPPO's critic gives one value for all UAVs of a world; faster, but it learns less."
    )

    @classmethod
    def class_for(cls, values: Mapping[str, Any]) -> type[Settings]:
        return MODELS.get(values.get("name", cls.name), "model")

    def __post_init__(self) -> None:
        super().__post_init__()
        self.refuse(self.recurrent and not self.hidden, "hidden", "needs a layer for model.rnn=gru")
        self.refuse(not self.shared and self.recurrent, "shared", "goes with model.rnn=none only")

    @property
    def recurrent(self) -> bool:
        """Whether the actor has a recurrent layer."""
        return self.rnn != "none"

    def make_network(self, layout: "Layout", n_out: int) -> "nn.Module":
        """A network from observations [*, F], whose columns the layout describes, to [*, n_out].

        Actors, critics and action values are such networks; a critic has the columns of what it
        observes.

        Raises:
            InputError: the model cannot read such a layout; the message names a setting.
        """
        raise NotImplementedError

    def make_encoder(self, layout: "Layout") -> "tuple[nn.Module, int]":
        """What an actor with a memory has before it: a network to [*, E], and E."""
        encode = resolved("damian.models.mlp:activated")
        return encode(self.make_network(layout, self.hidden[-1]), self.activation), self.hidden[-1]

    def make_head(self, layout: "Layout", n_out: int) -> "nn.Module":
        """What an actor with a memory has behind it: from the memory's state
        [*, ``hidden[-1]``] and the observation [*, F] to [*, n_out]."""
        return resolved("damian.models.mlp:LinearHead")(self.hidden[-1], n_out)


@MODELS.register("mlp")
@dataclass
class MlpConfig(ModelConfig):
    """A multilayer perceptron of all columns."""

    def make_network(self, layout: "Layout", n_out: int) -> "nn.Module":
        return resolved("damian.models.mlp:make_mlp")(self, layout.width, n_out)

    def make_encoder(self, layout: "Layout") -> "tuple[nn.Module, int]":
        """All hidden layers but the last one, in whose place the memory is."""
        return resolved("damian.models.mlp:make_encoder")(self, layout.width)


@MODELS.register("sets")
@dataclass
class SetsConfig(ModelConfig):
    """Rows of other UAVs, detections, requests and actions through layers that rows share.

    What it computes does not change with the order of the rows. With ``observation.actions`` each
    action's logit follows from its own row and from a context, which is made of sums and maxima
    over the other rows and of all other columns.
    """

    name: str = "sets"
    width: int = setting(32, "Width of the layers that read a row.", low=1, high=16384)

    def make_network(self, layout: "Layout", n_out: int) -> "nn.Module":
        encoder, _ = self.make_encoder(layout)
        joined = resolved("damian.models.sets:Joined")
        return joined(encoder, self.make_head(layout, n_out))

    def make_encoder(self, layout: "Layout") -> "tuple[nn.Module, int]":
        encoder = resolved("damian.models.sets:SetEncoder")(self, layout, self.width)
        return encoder, self.hidden[-1]

    def make_head(self, layout: "Layout", n_out: int) -> "nn.Module":
        if "actions" not in layout or n_out == 1:
            return super().make_head(layout, n_out)
        make = resolved("damian.models.sets:ActionHead")
        return make(self, layout["actions"], self.hidden[-1], self.width)
