"""The messages that flow between the stages: dataclasses, their protobuf schemas, topics and codec."""
