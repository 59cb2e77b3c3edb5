from google.protobuf.internal import containers as _containers
from google.protobuf import descriptor as _descriptor
from google.protobuf import message as _message
from collections.abc import Iterable as _Iterable, Mapping as _Mapping
from typing import ClassVar as _ClassVar, Optional as _Optional, Union as _Union

DESCRIPTOR: _descriptor.FileDescriptor

class CameraDetections(_message.Message):
    __slots__ = ("stamp_ns", "frame_id", "x_min", "y_min", "x_max", "y_max", "score", "label")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    X_MIN_FIELD_NUMBER: _ClassVar[int]
    Y_MIN_FIELD_NUMBER: _ClassVar[int]
    X_MAX_FIELD_NUMBER: _ClassVar[int]
    Y_MAX_FIELD_NUMBER: _ClassVar[int]
    SCORE_FIELD_NUMBER: _ClassVar[int]
    LABEL_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    frame_id: str
    x_min: _containers.RepeatedScalarFieldContainer[float]
    y_min: _containers.RepeatedScalarFieldContainer[float]
    x_max: _containers.RepeatedScalarFieldContainer[float]
    y_max: _containers.RepeatedScalarFieldContainer[float]
    score: _containers.RepeatedScalarFieldContainer[float]
    label: _containers.RepeatedScalarFieldContainer[str]
    def __init__(self, stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., x_min: _Optional[_Iterable[float]] = ..., y_min: _Optional[_Iterable[float]] = ..., x_max: _Optional[_Iterable[float]] = ..., y_max: _Optional[_Iterable[float]] = ..., score: _Optional[_Iterable[float]] = ..., label: _Optional[_Iterable[str]] = ...) -> None: ...

class LidarClusters(_message.Message):
    __slots__ = ("stamp_ns", "frame_id", "x", "y", "z", "size_x", "size_y", "size_z", "points")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    SIZE_X_FIELD_NUMBER: _ClassVar[int]
    SIZE_Y_FIELD_NUMBER: _ClassVar[int]
    SIZE_Z_FIELD_NUMBER: _ClassVar[int]
    POINTS_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    frame_id: str
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    z: _containers.RepeatedScalarFieldContainer[float]
    size_x: _containers.RepeatedScalarFieldContainer[float]
    size_y: _containers.RepeatedScalarFieldContainer[float]
    size_z: _containers.RepeatedScalarFieldContainer[float]
    points: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., z: _Optional[_Iterable[float]] = ..., size_x: _Optional[_Iterable[float]] = ..., size_y: _Optional[_Iterable[float]] = ..., size_z: _Optional[_Iterable[float]] = ..., points: _Optional[_Iterable[int]] = ...) -> None: ...

class VehiclePose(_message.Message):
    __slots__ = ("stamp_ns", "frame_id", "child_frame_id", "x", "y", "z", "qx", "qy", "qz", "qw", "vx", "vy", "vz", "wx", "wy", "wz")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    CHILD_FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    Z_FIELD_NUMBER: _ClassVar[int]
    QX_FIELD_NUMBER: _ClassVar[int]
    QY_FIELD_NUMBER: _ClassVar[int]
    QZ_FIELD_NUMBER: _ClassVar[int]
    QW_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    VZ_FIELD_NUMBER: _ClassVar[int]
    WX_FIELD_NUMBER: _ClassVar[int]
    WY_FIELD_NUMBER: _ClassVar[int]
    WZ_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    frame_id: str
    child_frame_id: str
    x: float
    y: float
    z: float
    qx: float
    qy: float
    qz: float
    qw: float
    vx: float
    vy: float
    vz: float
    wx: float
    wy: float
    wz: float
    def __init__(self, stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., child_frame_id: _Optional[str] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., z: _Optional[float] = ..., qx: _Optional[float] = ..., qy: _Optional[float] = ..., qz: _Optional[float] = ..., qw: _Optional[float] = ..., vx: _Optional[float] = ..., vy: _Optional[float] = ..., vz: _Optional[float] = ..., wx: _Optional[float] = ..., wy: _Optional[float] = ..., wz: _Optional[float] = ...) -> None: ...

class VehicleHistory(_message.Message):
    __slots__ = ("stamp_ns", "x", "y", "yaw", "vx", "vy")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: _containers.RepeatedScalarFieldContainer[int]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    yaw: _containers.RepeatedScalarFieldContainer[float]
    vx: _containers.RepeatedScalarFieldContainer[float]
    vy: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, stamp_ns: _Optional[_Iterable[int]] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., yaw: _Optional[_Iterable[float]] = ..., vx: _Optional[_Iterable[float]] = ..., vy: _Optional[_Iterable[float]] = ...) -> None: ...

class TrackHistory(_message.Message):
    __slots__ = ("stamp_ns", "x", "y", "vx", "vy", "coasting")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    COASTING_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: _containers.RepeatedScalarFieldContainer[int]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    vx: _containers.RepeatedScalarFieldContainer[float]
    vy: _containers.RepeatedScalarFieldContainer[float]
    coasting: _containers.RepeatedScalarFieldContainer[bool]
    def __init__(self, stamp_ns: _Optional[_Iterable[int]] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., vx: _Optional[_Iterable[float]] = ..., vy: _Optional[_Iterable[float]] = ..., coasting: _Optional[_Iterable[bool]] = ...) -> None: ...

class Track(_message.Message):
    __slots__ = ("id", "x", "y", "vx", "vy", "covariance", "existence", "age_ns", "coasting", "history")
    ID_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    COVARIANCE_FIELD_NUMBER: _ClassVar[int]
    EXISTENCE_FIELD_NUMBER: _ClassVar[int]
    AGE_NS_FIELD_NUMBER: _ClassVar[int]
    COASTING_FIELD_NUMBER: _ClassVar[int]
    HISTORY_FIELD_NUMBER: _ClassVar[int]
    id: int
    x: float
    y: float
    vx: float
    vy: float
    covariance: _containers.RepeatedScalarFieldContainer[float]
    existence: float
    age_ns: int
    coasting: bool
    history: TrackHistory
    def __init__(self, id: _Optional[int] = ..., x: _Optional[float] = ..., y: _Optional[float] = ..., vx: _Optional[float] = ..., vy: _Optional[float] = ..., covariance: _Optional[_Iterable[float]] = ..., existence: _Optional[float] = ..., age_ns: _Optional[int] = ..., coasting: _Optional[bool] = ..., history: _Optional[_Union[TrackHistory, _Mapping]] = ...) -> None: ...

class VehiclePath(_message.Message):
    __slots__ = ("t_s", "x", "y", "yaw", "front", "rear", "width")
    T_S_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    YAW_FIELD_NUMBER: _ClassVar[int]
    FRONT_FIELD_NUMBER: _ClassVar[int]
    REAR_FIELD_NUMBER: _ClassVar[int]
    WIDTH_FIELD_NUMBER: _ClassVar[int]
    t_s: _containers.RepeatedScalarFieldContainer[float]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    yaw: _containers.RepeatedScalarFieldContainer[float]
    front: float
    rear: float
    width: float
    def __init__(self, t_s: _Optional[_Iterable[float]] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., yaw: _Optional[_Iterable[float]] = ..., front: _Optional[float] = ..., rear: _Optional[float] = ..., width: _Optional[float] = ...) -> None: ...

class TrackFrame(_message.Message):
    __slots__ = ("sequence", "stamp_ns", "frame_id", "vehicle_history", "tracks", "pose_extrapolated", "epoch", "vehicle_path")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_HISTORY_FIELD_NUMBER: _ClassVar[int]
    TRACKS_FIELD_NUMBER: _ClassVar[int]
    POSE_EXTRAPOLATED_FIELD_NUMBER: _ClassVar[int]
    EPOCH_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_PATH_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    stamp_ns: int
    frame_id: str
    vehicle_history: VehicleHistory
    tracks: _containers.RepeatedCompositeFieldContainer[Track]
    pose_extrapolated: bool
    epoch: int
    vehicle_path: VehiclePath
    def __init__(self, sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., vehicle_history: _Optional[_Union[VehicleHistory, _Mapping]] = ..., tracks: _Optional[_Iterable[_Union[Track, _Mapping]]] = ..., pose_extrapolated: _Optional[bool] = ..., epoch: _Optional[int] = ..., vehicle_path: _Optional[_Union[VehiclePath, _Mapping]] = ...) -> None: ...

class ModalPath(_message.Message):
    __slots__ = ("probability", "x", "y")
    PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    probability: float
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, probability: _Optional[float] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ...) -> None: ...

class Mixture(_message.Message):
    __slots__ = ("components", "weight", "x", "y", "sigma_x", "sigma_y", "rho")
    COMPONENTS_FIELD_NUMBER: _ClassVar[int]
    WEIGHT_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    SIGMA_X_FIELD_NUMBER: _ClassVar[int]
    SIGMA_Y_FIELD_NUMBER: _ClassVar[int]
    RHO_FIELD_NUMBER: _ClassVar[int]
    components: int
    weight: _containers.RepeatedScalarFieldContainer[float]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    sigma_x: _containers.RepeatedScalarFieldContainer[float]
    sigma_y: _containers.RepeatedScalarFieldContainer[float]
    rho: _containers.RepeatedScalarFieldContainer[float]
    def __init__(self, components: _Optional[int] = ..., weight: _Optional[_Iterable[float]] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., sigma_x: _Optional[_Iterable[float]] = ..., sigma_y: _Optional[_Iterable[float]] = ..., rho: _Optional[_Iterable[float]] = ...) -> None: ...

class Prediction(_message.Message):
    __slots__ = ("track_id", "fallback", "paths", "mixture", "corridor_probability", "corridor_time_s")
    TRACK_ID_FIELD_NUMBER: _ClassVar[int]
    FALLBACK_FIELD_NUMBER: _ClassVar[int]
    PATHS_FIELD_NUMBER: _ClassVar[int]
    MIXTURE_FIELD_NUMBER: _ClassVar[int]
    CORRIDOR_PROBABILITY_FIELD_NUMBER: _ClassVar[int]
    CORRIDOR_TIME_S_FIELD_NUMBER: _ClassVar[int]
    track_id: int
    fallback: bool
    paths: _containers.RepeatedCompositeFieldContainer[ModalPath]
    mixture: Mixture
    corridor_probability: float
    corridor_time_s: float
    def __init__(self, track_id: _Optional[int] = ..., fallback: _Optional[bool] = ..., paths: _Optional[_Iterable[_Union[ModalPath, _Mapping]]] = ..., mixture: _Optional[_Union[Mixture, _Mapping]] = ..., corridor_probability: _Optional[float] = ..., corridor_time_s: _Optional[float] = ...) -> None: ...

class PredictionFrame(_message.Message):
    __slots__ = ("sequence", "stamp_ns", "frame_id", "model", "dt_s", "predictions", "vehicle_path")
    SEQUENCE_FIELD_NUMBER: _ClassVar[int]
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    DT_S_FIELD_NUMBER: _ClassVar[int]
    PREDICTIONS_FIELD_NUMBER: _ClassVar[int]
    VEHICLE_PATH_FIELD_NUMBER: _ClassVar[int]
    sequence: int
    stamp_ns: int
    frame_id: str
    model: str
    dt_s: float
    predictions: _containers.RepeatedCompositeFieldContainer[Prediction]
    vehicle_path: VehiclePath
    def __init__(self, sequence: _Optional[int] = ..., stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., model: _Optional[str] = ..., dt_s: _Optional[float] = ..., predictions: _Optional[_Iterable[_Union[Prediction, _Mapping]]] = ..., vehicle_path: _Optional[_Union[VehiclePath, _Mapping]] = ...) -> None: ...

class NodeHealth(_message.Message):
    __slots__ = ("stamp_ns", "node", "model", "uptime_s", "rate_hz", "latency_p50_ms", "latency_p99_ms", "frames", "dropped", "late", "refused", "problem", "input_hz")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    NODE_FIELD_NUMBER: _ClassVar[int]
    MODEL_FIELD_NUMBER: _ClassVar[int]
    UPTIME_S_FIELD_NUMBER: _ClassVar[int]
    RATE_HZ_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P50_MS_FIELD_NUMBER: _ClassVar[int]
    LATENCY_P99_MS_FIELD_NUMBER: _ClassVar[int]
    FRAMES_FIELD_NUMBER: _ClassVar[int]
    DROPPED_FIELD_NUMBER: _ClassVar[int]
    LATE_FIELD_NUMBER: _ClassVar[int]
    REFUSED_FIELD_NUMBER: _ClassVar[int]
    PROBLEM_FIELD_NUMBER: _ClassVar[int]
    INPUT_HZ_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    node: str
    model: str
    uptime_s: float
    rate_hz: float
    latency_p50_ms: float
    latency_p99_ms: float
    frames: int
    dropped: int
    late: int
    refused: int
    problem: str
    input_hz: float
    def __init__(self, stamp_ns: _Optional[int] = ..., node: _Optional[str] = ..., model: _Optional[str] = ..., uptime_s: _Optional[float] = ..., rate_hz: _Optional[float] = ..., latency_p50_ms: _Optional[float] = ..., latency_p99_ms: _Optional[float] = ..., frames: _Optional[int] = ..., dropped: _Optional[int] = ..., late: _Optional[int] = ..., refused: _Optional[int] = ..., problem: _Optional[str] = ..., input_hz: _Optional[float] = ...) -> None: ...

class GroundTruthFrame(_message.Message):
    __slots__ = ("stamp_ns", "frame_id", "id", "x", "y", "vx", "vy", "lidar_points")
    STAMP_NS_FIELD_NUMBER: _ClassVar[int]
    FRAME_ID_FIELD_NUMBER: _ClassVar[int]
    ID_FIELD_NUMBER: _ClassVar[int]
    X_FIELD_NUMBER: _ClassVar[int]
    Y_FIELD_NUMBER: _ClassVar[int]
    VX_FIELD_NUMBER: _ClassVar[int]
    VY_FIELD_NUMBER: _ClassVar[int]
    LIDAR_POINTS_FIELD_NUMBER: _ClassVar[int]
    stamp_ns: int
    frame_id: str
    id: _containers.RepeatedScalarFieldContainer[int]
    x: _containers.RepeatedScalarFieldContainer[float]
    y: _containers.RepeatedScalarFieldContainer[float]
    vx: _containers.RepeatedScalarFieldContainer[float]
    vy: _containers.RepeatedScalarFieldContainer[float]
    lidar_points: _containers.RepeatedScalarFieldContainer[int]
    def __init__(self, stamp_ns: _Optional[int] = ..., frame_id: _Optional[str] = ..., id: _Optional[_Iterable[int]] = ..., x: _Optional[_Iterable[float]] = ..., y: _Optional[_Iterable[float]] = ..., vx: _Optional[_Iterable[float]] = ..., vy: _Optional[_Iterable[float]] = ..., lidar_points: _Optional[_Iterable[int]] = ...) -> None: ...
