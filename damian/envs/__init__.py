"""TorchRL environments: ``UavEnv`` without delays, and the pipeline that adds delays and clocks."""
