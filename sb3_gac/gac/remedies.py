"""What GAC says when its guider adds nothing to the learner, or does too much, and which setting to change."""

#: Cause -> message of the warning, see :class:`sb3_gac.base.signs.GuidanceSigns`
REMEDIES = {
    "nothing by returns": (
        "the guider's own episodes return {guider:.5g} and the learner's {learner:.5g}, a difference of {low:.2f} to "
        "{high:.2f} standard deviations: guidance adds nothing. Raise target_kl, so that the guider may go further, give "
        "the learner more of the episodes by behaviour, or use AsymmetricSAC, which takes half of the arithmetic."
    ),
    "nothing by critics": (
        "the guider's actions gain {gain:.2g} standard deviations of Q over the learner's, by the learner's critics, and "
        "{upper:.2g} at most: guidance adds nothing. Raise target_kl, so that the guider may go further, or use "
        "AsymmetricSAC, which takes half of the arithmetic."
    ),
    "held back by kl": (
        "KL(guider || learner) is {kl:.2g}, a tenth of the {target:.2g} that target_kl allows or less, since kl_coef is "
        'still {coefficient:.2g}: the guider adds less than it may. Let kl_coef start lower, as in "auto_0.01", or raise '
        "kl_coef_learning_rate."
    ),
    "nothing by kl": (
        "KL(guider || learner) is {kl:.2g}, a tenth of the {target:.2g} that target_kl allows or less, and kl_coef is on "
        "its bound: the guider wants nothing that the learner does not do. Another target_kl changes nothing; see whether "
        "the privileged entry tells what the learner can't see, or use AsymmetricSAC, which takes half of the arithmetic."
    ),
    "too much by returns": (
        "the guider's own episodes return {guider:.5g} and the learner's {learner:.5g}, a difference of {low:.2f} to "
        "{high:.2f} standard deviations: the guider does what the learner can't (imitation gap). Lower target_kl, give "
        "the learner more of the episodes by behaviour, pull it by guidance, or let it see more (a history, a memory)."
    ),
    "too much by kl": (
        "KL(guider || learner) is {kl:.2g} where target_kl is {target:.2g}: the guider leaves the learner behind "
        '(imitation gap). Use guider="residual", set a hard bound by max_kl, widen kl_coef_bounds, or raise '
        "kl_coef_learning_rate."
    ),
}
