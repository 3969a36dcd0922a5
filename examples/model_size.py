"""A size of the network of your own: all of its numbers, under a name.

    trilight model nano --extend model_size.py
    trilight train tiny --extend model_size.py --set model=nano --data data/smoke --out runs/nano

A checkpoint holds the numbers and not the name, so that it opens where this file is unknown. What
a size cannot change, and what each number means, stands in model/config.py.
"""

from trilight.extend import SIZES, ModelConfig


def nano() -> ModelConfig:
    """Return a network of a quarter of a million parameters, which two cores train in a minute."""
    return ModelConfig(
        width=72,
        num_heads=2,
        encoder_layers=1,
        decoder_layers=2,
        hidden_width=144,
        num_registers=2,
        rope_num_freqs=2,
        rope_max_freq=4.0,
        head="linear",
    )


SIZES.register("nano", nano)
