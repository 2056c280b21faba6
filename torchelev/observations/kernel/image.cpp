// Images of many robots' maps: map_image.py.

#include "observations/kernel/image_of_robot.h"

using namespace images;

extern "C" int read_images(const Images* images, int num_threads) {
    return code_of([&] {
        const int threads = images->B * images->P > FEW ? num_threads : 1;
        const auto make = [&] { return Pixels(*images); };
        for_each(int(images->B), threads, make, [](int64_t b, Pixels& pixels) { pixels.show(b); });
    });
}
