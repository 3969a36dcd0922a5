"""USD's own judges of a stage: every validator that the wheel has."""

from typing import Any

from pxr import UsdValidation


def errors_of(stage: Any) -> list[str]:
    """Return what all of USD's validators say, but for the one thing that usd-core cannot know."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) >= 30
    return [
        f"{error.GetName()}: {error.GetMessage()}"
        for error in UsdValidation.ValidationContext(validators).Validate(stage)
        if not (
            error.GetName() == "MissingShaderIdInRegistry" and "shaderId 'ND_" in error.GetMessage()
        )
    ]
