// Records of a tile in shared memory.
#pragma once
#include "response.cuh"

// 28 words: lanes that read neighbouring entries meet different banks.
struct Loaded {
    Record record;
    float4 drift;  // rows . travel; w: the record's number (int)
};

INLINE Loaded loaded(const Record& record, float3 travel) {
    float3 drift = make_float3(dot(xyz(record.x), travel), dot(xyz(record.y), travel), dot(xyz(record.w), travel));
    return Loaded{record, with(drift, 0)};
}
