from replay.simulator.sensor_model import SensorModelV1


def test_version_1_is_frozen():
    """If this fails, the simulator was changed under the trackers measured with it: write a SensorModelV2 instead."""
    assert SensorModelV1().version == 1
    assert SensorModelV1().checksum() == "e0b566b403f677214ae05468791aba12f27a2b8a4d0be27c9731d7c57a567734"


def test_another_number_is_another_model():
    assert SensorModelV1(p_detect=0.99).checksum() != SensorModelV1().checksum()
