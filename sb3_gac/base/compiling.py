"""The decision whether gradient steps are compiled: as ``compile`` says, or on "auto" where compiling is possible and pays."""

import warnings
from abc import abstractmethod

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_gac.base.policy import AsymmetricPolicy
from sb3_gac.optim.compile import PAYS_FROM, CannotCompileError, Programs, check_can_compile, missing_compiler
from sb3_gac.optim.parallel import has_side_effects

AUTO = "auto"


class Compilation(BaseAlgorithm):
    """
    Decides, when ``learn`` begins, whether gradient steps are compiled; ``train`` without ``learn`` compiles on request alone.

    A model that comes from ``resume`` keeps the decision of the run before, because results depend on it to the bit.
    """

    compile: bool | str
    policy: AsymmetricPolicy
    programs: Programs
    #: The decision of the last ``learn`` and its reason, as a sentence; empty unless ``compile`` is "auto"
    compile_decision: str = ""
    _compiles_on_auto = False
    _failed_to_compile = False
    #: Whether this model comes from ``resume`` and has not begun to learn since
    _resumed = False

    @property
    def compiles(self) -> bool:
        """Whether gradient steps are compiled."""
        return self._compiles_on_auto if self.compile == AUTO else bool(self.compile)

    @abstractmethod
    def gradient_steps_in(self, steps: int) -> int:
        """
        An estimate of the gradient steps in a stretch of training.

        :param steps: number of environment steps to come, in all environments together
        :return: approximate number of gradient steps that come with them
        """

    def decide_compilation(self) -> None:
        """Decide before training begins; :attr:`compile_decision` keeps the decision, printed if ``verbose`` is 1 or more."""
        before = self._compiles_on_auto if self._resumed else None
        self._resumed = self._failed_to_compile = False
        if self.compile != AUTO:
            self._compiles_on_auto = bool(self.compile)  # kept in checkpoints
            self.compile_decision = ""
            return
        self._compiles_on_auto, why = self._decide(before)
        self.compile_decision = f'compile="auto": gradient steps are {"" if self.compiles else "not "}compiled, {why}.'
        if self.verbose >= 1:
            print(self.compile_decision)  # noqa: T201  # as SB3 does

    def _decide(self, before: bool | None) -> tuple[bool, str]:
        """
        :param before: decision of the run that this model goes on with; ``None`` for a new run
        :return: whether to compile, and the reason in words
        """
        if before is False:
            return False, "as before the run was stopped"
        try:
            self.check_can_compile()
        except CannotCompileError as error:
            return False, f"for compilation {error.why}"
        missing = missing_compiler(self.device)
        if missing is not None:
            return False, f"for there is no {missing}"
        if before:
            return True, "as before the run was stopped"
        if self.programs:
            return True, "as they were before"
        to_come = self.gradient_steps_in(self._total_timesteps - self.num_timesteps)
        if to_come < PAYS_FROM:
            return False, f"for {to_come:,} are to come, and half a minute of compiling pays from {PAYS_FROM:,} on"
        return True, f"for {to_come:,} are to come, which pays for half a minute of compiling"

    def check_can_compile(self) -> None:
        """
        Check that gradient steps can be compiled.

        :raises CannotCompileError: naming what stands in the way: a kind of network, an optimiser or torch's version
        """
        if any(self.policy.rnn_types.values()):
            raise CannotCompileError("can't do recurrent policies", "leave it False")
        if has_side_effects(self.policy):
            raise CannotCompileError("can't do dropout or batch normalisation", "leave them out, or leave it False")
        check_can_compile()
        for name, network in self.policy.trained.items():
            if not network.can_be_compiled:
                raise CannotCompileError(
                    "can do torch's Adam and AdamW, without amsgrad, foreach or fused=False, but the optimiser of "
                    f"{name} is {type(network.optimizer).__name__}",
                    "choose another optimizer_class, or leave compile False",
                )

    def _compiling_failed(self, error: Exception) -> None:
        """
        Warn that compiling failed, where ``compile`` is "auto"; later rounds of gradient steps are not compiled.

        :param error: error of the compiler
        """
        if not self._failed_to_compile:
            reason = str(error).strip().splitlines()[0]
            warnings.warn(
                f'compile="auto": compiling failed, and gradient steps go on without. {type(error).__name__}: {reason}',
                stacklevel=2,
            )
        self._failed_to_compile = True

    def _excluded_save_params(self) -> list[str]:
        own = ["compile_decision", "_compiles_on_auto", "_failed_to_compile", "_resumed"]
        return [*super()._excluded_save_params(), *own]
