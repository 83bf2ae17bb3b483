"""Which devices a process computes on."""

import os

import jax


def use_all_cores() -> None:
    """Make each processor core a JAX device, so that the missions of a batch are shared among them.

    This is a setting of the whole process, so no other function of swarmsim makes it; the command line does. It must be
    made before JAX has computed anything: later it has no effect, and a batch runs on the devices that there are. A
    number in ``JAX_NUM_CPU_DEVICES`` has precedence.
    """
    if os.environ.get("JAX_NUM_CPU_DEVICES"):
        return
    try:
        jax.config.update("jax_num_cpu_devices", os.cpu_count() or 1)
    except RuntimeError:  # JAX has started
        return
