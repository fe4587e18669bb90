// A control stage in C++ without any library of ours: it flies towards a point of the trajectory that lies
// a little ahead. docs/own_stack.md tells what is said on standard input and output.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <iostream>
#include <sstream>
#include <string>
#include <vector>

struct State { double x, y, z, qx, qy, qz, qw; };
struct Command { double vx, vy, vz, yaw_rate; };

constexpr int FIELDS = 12;  // of a row of the trajectory: t, x y z, vx vy vz, ax ay az, yaw, blocking_yaw
constexpr double AHEAD_S = 0.6, SPEED_LIMIT_M_S = 3.0, TURN_1_S = 2.0;

// CDR as ROS 2 has it: four bytes that say little-endian, then each number at a multiple of its size.
class Reader {
public:
    explicit Reader(const std::string & bytes) : bytes_(bytes) {}
    template <typename T> T number() {
        at_ = 4 + (at_ - 4 + sizeof(T) - 1) / sizeof(T) * sizeof(T);
        T value;
        std::memcpy(&value, bytes_.data() + at_, sizeof(T));
        at_ += sizeof(T);
        return value;
    }
    void header() {  // std_msgs/Header: a time and a name
        number<int32_t>();
        number<uint32_t>();
        name();
    }
    void name() { const auto size = number<uint32_t>(); at_ += size; }
private:
    const std::string & bytes_;
    size_t at_ = 4;
};

class Writer {
public:
    template <typename T> void number(T value) {
        bytes_.resize(4 + (bytes_.size() - 4 + sizeof(T) - 1) / sizeof(T) * sizeof(T));
        bytes_.append(reinterpret_cast<const char *>(&value), sizeof(T));
    }
    void name(const std::string & text) {
        number<uint32_t>(text.size() + 1);
        bytes_.append(text.c_str(), text.size() + 1);
    }
    const std::string & bytes() const { return bytes_; }
private:
    std::string bytes_{"\0\1\0\0", 4};
};

// The velocity that leads to where the trajectory is in a moment. A fault strikes in a call of it.
[[gnu::noinline]] Command pursue(const std::vector<double> & rows, const State & here, double now_s) {
    const size_t count = rows.size() / FIELDS;
    if (count == 0) return {0, 0, 0, 0};
    size_t row = 0;
    while (row + 1 < count && rows[row * FIELDS] < now_s + AHEAD_S) ++row;
    const double * target = &rows[row * FIELDS];
    double velocity[3] = {target[1] - here.x, target[2] - here.y, target[3] - here.z};
    double length = 0;
    for (double & part : velocity) { part /= AHEAD_S; length += part * part; }
    length = std::sqrt(length);
    if (length > SPEED_LIMIT_M_S) for (double & part : velocity) part *= SPEED_LIMIT_M_S / length;
    const double yaw = std::atan2(2 * (here.qx * here.qy + here.qw * here.qz),
                                  1 - 2 * (here.qy * here.qy + here.qz * here.qz));
    const double turn = std::remainder(target[10] - yaw, 2 * M_PI);
    return {velocity[0], velocity[1], velocity[2], TURN_1_S * turn};
}

int main() {
    std::ios::sync_with_stdio(false);
    std::vector<double> rows;
    State here{};
    std::string line, word, topic, bytes;
    while (std::getline(std::cin, line)) {
        std::istringstream words(line);
        size_t size = 0;
        int64_t number, now_ns;
        words >> word;
        if (word == "zenfi") {                      // zenfi VERSION STAGE LIFE BYTES, and the mission
            words >> number >> topic >> number >> size;
            bytes.resize(size);
            std::cin.read(bytes.data(), size);
            std::cout << "ready\n" << std::flush;
        } else if (word == "message") {             // message TOPIC SEQ READY_NS BYTES, and CDR
            words >> topic >> number >> now_ns >> size;
            bytes.resize(size);
            std::cin.read(bytes.data(), size);
            Reader message(bytes);
            message.header();
            if (topic == "odometry") {
                message.name();
                for (double * part : {&here.x, &here.y, &here.z, &here.qx, &here.qy, &here.qz, &here.qw})
                    *part = message.number<double>();
            } else if (topic == "trajectory") {
                message.number<uint32_t>();
                message.number<uint32_t>();
                message.number<uint8_t>();
                rows.resize(message.number<uint32_t>());
                for (double & value : rows) value = message.number<double>();
            }
        } else if (word == "step") {                // step NOW_NS
            words >> now_ns;
            const Command command = pursue(rows, here, now_ns / 1e9);
            Writer message;                         // geometry_msgs/TwistStamped
            message.number<int32_t>(now_ns / 1000000000);
            message.number<uint32_t>(now_ns % 1000000000);
            message.name("map");
            for (double part : {command.vx, command.vy, command.vz, 0.0, 0.0, command.yaw_rate})
                message.number<double>(part);
            std::cout << "put command " << message.bytes().size() << '\n' << message.bytes() << "done\n"
                      << std::flush;
        } else {
            std::cerr << "pursuit: not understood: " << line << std::endl;
            return 1;
        }
    }
}
